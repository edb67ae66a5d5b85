"""Exports what a run has learned, or the objects that refract light.

python -m experiments.export --run=runs/ball --what=mesh --out=ball.ply

    mesh      level set of the field's density at --level, and the background cube or sphere, if
              any, with normals and colours; of a field with a surface (as neus), that surface
    points    the same surfaces as points of a grid
    splats    the Gaussians of a run with --field=splats, for viewers of splats
    object    the objects: those of R3F, or the scene's meshes; with their shading normals
    textured_mesh  the cube, sphere or environment of a backdrop, as GLB
    faces     the six faces of a backdrop in one image: PNG, or linear EXR
    coverage  how many pixels see each vertex of a backdrop, in the order of faces: PNG (magenta:
              none), or the numbers as EXR
    panorama  what is seen of a backdrop from the centre of the scene: PNG, or linear EXR

For object, --run may also be the folder of a reconstruction. A field learns nothing inside clear
glass, so mesh and points show the surroundings of the objects.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from absl import flags
from etils import epy

from experiments.cli import app, outputs
from experiments.cli import flags as cli_flags
from experiments.cli.progress import ProgressBar

if TYPE_CHECKING:
    from refref_jax.render import Model

with epy.lazy_imports():
    import numpy as np

    from experiments.exporting import backdrop_surface, field_mesh, object_meshes
    from refref_jax.data import image_files
    from refref_jax.fields import registry
    from refref_jax.reconstruct import grids
    from refref_jax.render import checkpoint_io
    from refref_jax.training import run_folder

# Endings of the files of each kind.
_ENDINGS = {
    "mesh": (".ply",),
    "points": (".ply",),
    "splats": (".ply",),
    "object": (".ply",),
    "textured_mesh": (".glb",),
    "faces": (".png", ".exr"),
    "panorama": (".png", ".exr"),
    "coverage": (".png", ".exr"),
}

_RUN = cli_flags.run()
_WHAT = cli_flags.enum("what", None, list(_ENDINGS), "Output type.", formerly={"body": "object"})
_OUT = cli_flags.out("File to write: PLY, GLB for textured_mesh, PNG or EXR for images.")
_OVERWRITE = cli_flags.overwrite("the file, or those of several objects")
_STEP = cli_flags.step()
_LEVEL = flags.DEFINE_float(
    "level", 10.0, "Density of the surface per world unit; 10 halves light over 0.07 units.", 1e-6
)
_RESOLUTION = flags.DEFINE_integer("resolution", 128, "Cells along each edge of the box.", 4)
_BOX = flags.DEFINE_float(
    "box",
    None,
    "Half-extent of the box around the model's centre, world units; that of the model by default.",
    1e-6,
)
cli_flags.allow_outside()


def main() -> None:
    """Writes one file, or one per object."""
    run, out = Path(_RUN.value), Path(_OUT.value)
    outputs.check_file(out, overwrite=_OVERWRITE.value)
    others = (cli_flags.RECONSTRUCTION,) if _WHAT.value == "object" else ()
    cli_flags.check_run(run, holds=(cli_flags.RUN, *others))
    if _WHAT.value == "object":
        written = object_meshes.write(run, out, overwrite=_OVERWRITE.value)
    elif _WHAT.value in ("mesh", "points"):
        written = _write_field(_with_field(run), out)
    elif _WHAT.value == "splats":
        written = _write_splats(checkpoint_io.load_model(run, step=_STEP.value), run, out)
    else:
        written = _write_backdrop(checkpoint_io.load_model(run, step=_STEP.value), run, out)
    for path in written:
        print(f"Wrote:  {path}")
    if _WHAT.value == "splats":
        print("Next: open it with a viewer of Gaussian splats: z is up.")
    elif out.suffix.lower() in (".png", ".exr"):
        print("Next: look at it; Blender and Mitsuba read a panorama as an environment map.")
    else:
        print("Next: open it with Blender, MeshLab or CloudCompare: z is up.")


def _refuse_other_files(out: str | None) -> None:
    endings = _ENDINGS[_WHAT.value] if _WHAT.value else sum(_ENDINGS.values(), ())
    if out is not None and not out.lower().endswith(endings):
        kinds = " or ".join(dict.fromkeys(ending[1:].upper() for ending in endings))
        raise ValueError(
            f"--out is {out}, which is not a {kinds} file. Give a name that ends in "
            f"{' or '.join(dict.fromkeys(endings))}."
        )


app.check(_OUT, _refuse_other_files)


def _with_field(run: Path) -> Model:
    """Returns the model of a run.

    Raises:
      ValueError: if it has a backdrop, Gaussian splats, or a field with sub-spaces or deformation.
    """
    model = checkpoint_io.load_model(run, step=_STEP.value)
    if model.config.splats is not None:
        raise ValueError(
            f"{run} consists of Gaussian splats, and has no density. Use --what=splats, or export "
            "a run with --field=zipnerf."
        )
    if model.config.backdrop is not None:
        raise ValueError(
            f"The far field of {run} is a backdrop, which has no density. Use "
            "--what=textured_mesh, faces or panorama."
        )
    if registry.has_sub_spaces(model.config.field):
        raise ValueError(
            f"{run} has fields of kind {model.config.field.kind}, whose sub-spaces are blended "
            "along whole light paths: a point has no density and colour. Use experiments.render, "
            "or export a run with --field=zipnerf."
        )
    if registry.has_deformation(model.config.field):
        raise ValueError(
            f"{run} has fields of kind {model.config.field.kind}, which bend rays: where a point "
            "of the scene is in them depends on the ray. Use experiments.render, or export a run "
            "with --field=zipnerf."
        )
    return model


def _write_splats(model: Model, run: Path, out: Path) -> list[Path]:
    if model.config.splats is None:
        raise ValueError(
            f"{run} does not consist of Gaussian splats. Train one with --field=splats, or use "
            "--what=mesh."
        )
    from refref_jax.splats import gaussians

    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as draft:
        gaussians.write_ply(draft, model.params.field)
    return [out]


def _write_backdrop(model: Model, run: Path, out: Path) -> list[Path]:
    backdrop_surface.check(model, run)
    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as draft:
        if _WHAT.value == "textured_mesh":
            backdrop_surface.write_textured_mesh(draft, model)
            return [out]
        if _WHAT.value == "coverage":
            _write_coverage(draft, run, is_exr=out.suffix.lower() == ".exr")
            return [out]
        grid = backdrop_surface.faces(model)
        if _WHAT.value == "faces":
            linear = backdrop_surface.as_sheet(grid)
        else:
            linear = backdrop_surface.panorama(model, height=2 * (grid.shape[1] - 1))
        print(f"Image:  {linear.shape[1]} x {linear.shape[0]} pixels")
        if out.suffix.lower() == ".exr":
            image_files.write_exr(draft, linear)
        else:
            image_files.write_rgb(draft, backdrop_surface.as_srgb(linear))
    return [out]


def _write_coverage(draft: Path, run: Path, *, is_exr: bool) -> None:
    seen = run_folder.read_coverage(run)
    print(f"Never seen: {np.mean(seen == 0.0):.1%} of the vertices")
    if is_exr:
        image_files.write_exr(draft, backdrop_surface.as_sheet(seen[..., None]))
    else:
        image_files.write_rgb(draft, backdrop_surface.as_heat(seen))


def _write_field(model: Model, out: Path) -> list[Path]:
    grids.import_skimage()  # reports a missing package early
    if registry.has_surface(model.config.field):
        return _write_surface(model, out)
    space, radius = model.config.space, model.config.radius
    centre = np.array(model.config.centre)
    half = _BOX.value or radius
    if space != "unbounded":
        half = min(half, radius)  # there is nothing outside
    around = f" around ({', '.join(f'{x:g}' for x in centre)})" if centre.any() else ""
    print(f"Box:    from {-half:g} to {half:g} along each axis{around}, {_RESOLUTION.value} cells")
    if space == "unbounded":
        print("        The scene extends beyond it: a larger --box shows more of it.")
    with ProgressBar("density", _RESOLUTION.value + 1) as bar:
        density = field_mesh.sample_density(
            model,
            centre - half,
            centre + half,
            resolution=_RESOLUTION.value,
            step=lambda done, total: bar.show(done, "slices"),
        )
    if space == "bounded" and half == radius:
        density = field_mesh.with_background(density, level=_LEVEL.value)
        print("Background: the faces of the box, on which the model is opaque")
    if space == "spherical" and math.sqrt(3.0) * half > radius:
        density = field_mesh.with_sphere(
            density, level=_LEVEL.value, radius=radius, centre=model.config.centre
        )
        print(f"Background: the sphere of radius {radius:g}, on which the model is opaque")
    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as draft:
        if _WHAT.value == "mesh":
            surface = field_mesh.find_surface(density, level=_LEVEL.value)
            colours = _colours(model, surface.vertices, surface.normals, density.spacing)
            field_mesh.write_surface(draft, surface, colours)
            print(f"Mesh:   {len(surface.vertices)} vertices, {len(surface.faces)} faces")
        else:
            points = field_mesh.find_points(density, level=_LEVEL.value)
            colours = _colours(model, points.points, points.normals, density.spacing)
            field_mesh.write_points(draft, points, colours)
            print(f"Points: {len(points.points)}")
    return [out]


def _write_surface(model: Model, out: Path) -> list[Path]:
    """Writes the surface of a field that has one, without the background.

    Raises:
      ValueError: if --level is given, or there is no surface in the box.
    """
    kind = model.config.field.kind
    if _LEVEL.present:
        raise ValueError(
            f"--level={_LEVEL.value:g} has no effect on fields of kind {kind}, whose surface is "
            "where their signed value is 0. Leave it out."
        )
    low, high = field_mesh.surface_box(model, _BOX.value)
    print(f"Box:    {low.round(3)} to {high.round(3)}, {_RESOLUTION.value} cells along each edge")
    with ProgressBar("surface", _RESOLUTION.value + 1) as bar:
        signed = field_mesh.sample_surface(
            model,
            low,
            high,
            resolution=_RESOLUTION.value,
            step=lambda done, total: bar.show(done, "slices"),
        )
    with outputs.fresh_file(out, overwrite=_OVERWRITE.value) as draft:
        if _WHAT.value == "mesh":
            surface = field_mesh.zero_surface(signed)
            _, _, rgb = field_mesh.look_up_surfaces(model, surface.vertices, -surface.normals)
            field_mesh.write_surface(draft, surface, image_files.to_bytes(rgb))
            print(f"Mesh:   {len(surface.vertices)} vertices, {len(surface.faces)} faces")
        else:
            points = field_mesh.outer_points(signed)
            _, _, rgb = field_mesh.look_up_surfaces(model, points.points, -points.normals)
            field_mesh.write_points(draft, points, image_files.to_bytes(rgb))
            print(f"Points: {len(points.points)}")
    return [out]


def _colours(model: Model, points: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """Returns the 8-bit sRGB just below the surface, viewed along the normals."""
    below = points - 0.5 * spacing * normals
    return image_files.to_bytes(field_mesh.look_up_points(model, below, -normals, width=spacing)[1])


if __name__ == "__main__":
    app.run(main, again="repeat the command to export again; --overwrite replaces the files.")
