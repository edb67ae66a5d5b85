"""R3F: geometry and refractive index from posed images and masks, without manual steps.

The visual hull of the masks is a scalar field on a grid (`masks`). Its zero level set is a
mesh (`grids`), which is cleaned, smoothed and remeshed (`refinement`). An occupancy field trained
on the masks (`occupancy`, as in the paper) yields the same kind of grid. `mesh_distance` compares
the mesh with a ground-truth mesh and with the masks; `refractive_index` estimates the index from
images. `families` finds balls, tori, surfaces of revolution (`revolution`) and convex polyhedra
(`polyhedra`) in noisy meshes, as surfaces whose few unknowns light can determine (`shapes`).
`interiors` has vessels with liquid and air inside, whose walls are profiles (`walls`);
`interior_search` finds out what is inside, from looks at many hypotheses (`interior_looks`).
"""


class ReconstructionError(ValueError):
    """Masks, a grid or a mesh contain no object, or a required package is not installed.

    The message says what is wrong and what to do.
    """
