"""The report on a reconstruction in words: a Markdown file, with its pictures beside it."""

from pathlib import Path

from experiments.cli import app
from experiments.r3f import body
from experiments.r3f.records import IndexFacts, Reconstruction, ReportFacts

_SPLITS = {
    "test": "test views, from which nothing was made",
    "val": "validation views, from which nothing was made",
    "train": "training views, the very ones that it was made from",
}


def markdown(out: Path, found: Reconstruction, facts: ReportFacts) -> str:
    """Returns the text of a report.

    Args:
      out: folder of the reconstruction; its pictures are expected in `pictures`.
      found: geometry and index.
      facts: what was measured of them.
    """
    geometry = found.geometry
    parts = [
        f"# The object of {found.scene}, reconstructed",
        f"From {geometry.masks} masks of {geometry.width} x {geometry.height} pixels and their "
        f"poses; {_of_index(found.index)}.",
        *(f"**Doubtful:** {doubt}" for doubt in geometry.doubts),
        _table(out, found, facts),
        f"## Silhouettes\n\nMeasured on {len(facts.overlaps)} {_SPLITS[facts.split]}. IoU is the "
        "pixels in both mask and silhouette over those in either.",
        "![Masks and silhouettes](pictures/overlap.png)",
        "![Errors of the silhouettes](pictures/iou.png)",
        f"## Surface\n\n{_of_truth(facts)}",
        "![Normals, and the distance to the true surface](pictures/surface.png)",
        *_pictures_of_index(out),
        "## How it was made\n\n" + _making(found),
        "## Go on\n\n```bash\n"
        + app.shell("train", "--scene=SCENE", "--reconstruction=OUT", "--out=RUN")
        + "\n```\n\nwith SCENE the scene's folder and OUT this one.",
    ]
    return "\n\n".join(parts) + "\n"


def _of_index(index: IndexFacts) -> str:
    if index.source == "given":
        return "the index of refraction was given"
    return "the index of refraction was estimated from their images"


def _table(out: Path, found: Reconstruction, facts: ReportFacts) -> str:
    geometry, index = found.geometry, body.index_facts(found)
    error = "" if index.error is None else f" ± {index.error:.4f} (one standard deviation)"
    surface = body.surface_file(out, found).relative_to(out)
    rows = [
        ("surface", f"[{geometry.mesh}]({surface}), {geometry.faces:,} triangles"),
        ("diameter, volume", f"{geometry.diameter:.3f}, {geometry.volume:.3f} (world units)"),
        ("index of refraction", f"**{index.index:.4f}**{error}, {index.source}"),
        (
            "silhouettes: mean IoU, least",
            f"**{facts.mean_overlap:.4f}**, {min(facts.overlaps):.4f}",
        ),
    ]
    if found.light is not None:
        light = found.light
        kept = f"kept, with index {light.index:.4f}" if light.kept else "left out"
        rows.append(
            (
                "error of validation views, by light",
                f"{light.before:.4f} before, {light.after:.4f} after; {kept}",
            )
        )
    if facts.truth is not None:
        truth = facts.truth
        rows += [
            (
                "distance to the truth: mean (Chamfer), largest",
                f"**{truth.chamfer:.3%}**, {truth.furthest:.2%} of the diameter",
            ),
            (
                "angle to the true normals: mean, 99 of 100 below",
                f"**{truth.normal_error:.2f}°**, {truth.normal_error_99:.1f}°",
            ),
        ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def _of_truth(facts: ReportFacts) -> str:
    shown = (
        "No mask shows a cavity, a dent that no line of sight grazes, or what lies within glass: "
        "the body is filled, with one index. Normals are those of the camera's frame: right is "
        "red, up green, towards it blue."
    )
    if facts.truth is None:
        return f"{facts.remark} {shown}"
    return (
        f"{facts.remark} {shown} Distances are those of the surface that is seen to the closest "
        "point of the true one."
    )


def _pictures_of_index(out: Path) -> list[str]:
    found = sorted((out / "index").glob("*.png"))
    return ["## Index of refraction"] * bool(found) + [
        f"![{path.stem.replace('_', ' ')}](index/{path.name})" for path in found
    ]


def _making(found: Reconstruction) -> str:
    config, geometry = found.config, found.geometry
    told = [
        f"- `--geometry={config.geometry} --resolution={config.resolution} "
        f"--outliers={config.outliers} --light_steps={config.light_steps} --seed={config.seed}`"
        + (f" `--ior={config.index:g}`" if config.index is not None else "")
        + (f" `--background={config.space}`" if config.space is not None else "")
        + (f" `--radius={config.radius:g}`" if config.radius is not None else ""),
        f"- refined: {', '.join(geometry.stages) or 'nothing to do'}",
        *(f"- left out {refused}" for refused in geometry.refused),
    ]
    return "\n".join(told)
