"""Writes a run's surfaces as PLY for other programs: the field's, or the bodies that bend light.

python -m experiments.export --run=runs/ball --what=mesh --out=ball.ply

    mesh      where the field's density crosses --level, and the walls of a bounded scene, with
              normals and colours
    points    the same surfaces as points of a grid
    body      the bodies: those of R3F, or the scene's meshes; with the normals that bend light

Of body, --run may be a reconstruction's folder as well. In clear glass a field learns nothing, so
mesh and points show what is around the bodies. Nothing is overwritten.
"""

from pathlib import Path

import numpy as np
from absl import flags

from experiments import commands
from experiments.exporting import bodies, field_grid, surfaces
from refref_jax.data import files
from refref_jax.reconstruct.isosurface import import_skimage
from refref_jax.render import Model, load_model

_RUN = flags.DEFINE_string("run", None, "Folder of a trained run.", required=True)
_WHAT = flags.DEFINE_enum("what", None, ["mesh", "points", "body"], "What to write.", required=True)
_OUT = flags.DEFINE_string("out", None, "The PLY file; must not exist.", required=True)
_STEP = flags.DEFINE_integer("step", None, "Checkpoint to use; the newest if not given.", 0)
_LEVEL = flags.DEFINE_float(
    "level", 10.0, "Density of the surface per world unit; 10 halves light in 0.07 units.", 1e-6
)
_RESOLUTION = flags.DEFINE_integer("resolution", 128, "Cells along each edge of the box.", 4)
_BOX = flags.DEFINE_float(
    "box",
    None,
    "Half edge of the box around the origin, world units; the model's if not given.",
    1e-6,
)


def main() -> None:
    """Writes one file, or one for each body."""
    run, out = Path(_RUN.value), Path(_OUT.value)
    if out.suffix.lower() != ".ply":
        raise ValueError(f"--out is {out}, which is no PLY file. Give a name that ends with .ply.")
    if out.exists():
        raise ValueError(f"{out} exists, and nothing is overwritten. Give another --out.")
    if _WHAT.value == "body":
        written = bodies.write(run, out)
    else:
        written = _write_field(load_model(run, step=_STEP.value), out)
    for path in written:
        print(f"Wrote:  {path}")
    print("Open it with Blender, MeshLab or CloudCompare: z is up.")


def _write_field(model: Model, out: Path) -> list[Path]:
    import_skimage()  # so that its lack is told before the work
    is_bounded = model.config.space == "bounded"
    half = _BOX.value or model.config.radius
    if is_bounded:
        half = min(half, model.config.radius)  # there is nothing beyond
    print(f"Box:    from {-half:g} to {half:g} along each axis, {_RESOLUTION.value} cells")
    if not is_bounded:
        print("        The scene goes on beyond it: a larger --box shows more of it.")
    with commands.ProgressBar("density", _RESOLUTION.value + 1) as bar:
        density = field_grid.sample_density(
            model,
            np.full(3, -half),
            np.full(3, half),
            resolution=_RESOLUTION.value,
            step=lambda done, total: bar.show(done, "slices"),
        )
    if is_bounded and half == model.config.radius:
        density = surfaces.with_walls(density, level=_LEVEL.value)
        print("Walls:  the box's faces, on which the model is opaque")
    out.parent.mkdir(parents=True, exist_ok=True)
    if _WHAT.value == "mesh":
        surface = surfaces.find_surface(density, level=_LEVEL.value)
        colours = _colours(model, surface.vertices, surface.normals, density.spacing)
        surfaces.write_surface(out, surface, colours)
        print(f"Mesh:   {len(surface.vertices)} vertices, {len(surface.faces)} faces")
    else:
        points = surfaces.find_points(density, level=_LEVEL.value)
        colours = _colours(model, points.points, points.normals, density.spacing)
        surfaces.write_points(out, points, colours)
        print(f"Points: {len(points.points)}")
    return [out]


def _colours(model: Model, points: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """Returns what is seen just below the surface by who looks straight at it, 8-bit sRGB."""
    below = points - 0.5 * spacing * normals
    return files.to_bytes(field_grid.look_up_points(model, below, -normals, width=spacing)[1])


if __name__ == "__main__":
    commands.run(main)
