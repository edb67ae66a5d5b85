"""Defines the methods that a benchmark compares: their names, labels and training options.

A method is a set of options of `experiments.train`, so adding one means adding a line here.
Everything else is that of the preset for all methods: sizes, schedule and footprint. `oracle`,
`--paths=paper --interior=field`, therefore has the published light paths and fields, and
`oracle_as_published` also has the scene bounds, normals, losses and evaluation of the paper's
released code; `docs/benchmark.md` lists the differences that remain. A baseline is another method
of the paper's tables: its idea on the fields and preset of all others. The group `paper` has what
stands for a row of the paper's main table. Ablations of `oracle` remove one component; those of
`tree`, our method, change one. An ablation that equals the preset is skipped (`same_as`), as is one
that equals the scene's own choice (`same_inside`). Nerfacto's fields (`oracle_nerfacto`) define
their own sizes, samples and footprint, a cone.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

from etils import epy

from experiments.cli import app

with epy.lazy_imports():
    from refref_jax.fields import registry
    from refref_jax.training import presets

Need = Literal["meshes", "masks", "colours", "backdrop", "walls"]
Group = Literal["main", "baseline", "ablation of the oracle", "ablation of the tree"]

RECONSTRUCTION = "reconstruction"
"""Folder for the reconstruction that R3F methods share; no method may have this name."""


@dataclasses.dataclass(frozen=True)
class Method:
    """A method to train scenes with.

    Attributes:
      name: name in commands and folders.
      label: label in tables.
      group: comparison to which it belongs.
      train: options of `experiments.train`.
      requires: requirements on a scene: `meshes` of its objects, `masks` of its training images,
        `colours` of all its parts in scene.json, `backdrop` if all light ends on its background
        and nothing but that is learned, `walls` if a cube or a sphere is around it.
      reconstructed: whether the objects come from R3F instead of the scene's meshes.
      published: row of the paper's tables with the same method, if there is one.
      evaluate: options of `experiments.evaluate`, in place of those of the benchmark.
    """

    name: str
    label: str
    group: Group
    train: tuple[str, ...]
    requires: tuple[Need, ...] = ("meshes",)
    reconstructed: bool = False
    published: str | None = None
    evaluate: tuple[str, ...] = ()


_ORACLE = ("--paths=paper", "--interior=field")
_TREE = ("--paths=tree",)

# What the released code does otherwise than `oracle`; near and far follow from `contraction`.
_RELEASE = (
    *_ORACLE,
    "--contraction=always",
    "--shading=flat",
    "--footprint=cone",
    "--colour_network=skip",
    "--data_loss=charbonnier",
    "--path_losses=transmitted",
    "--adam_b2=0.999",
)


def _over(options: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    """Overrides options by others of the same name."""
    return tuple({word.partition("=")[0]: word for word in (*options, *others)}.values())


def _ablated(name: str, label: str, *options: str, published: str | None = None) -> Method:
    """Returns the oracle with changed options."""
    train = _over(_ORACLE, options)
    return Method(name, label, "ablation of the oracle", train, published=published)


def _varied(name: str, label: str, *options: str, colours: tuple[Need, ...] = ()) -> Method:
    """Returns the tree with changed options."""
    train = _over(_TREE, options)
    return Method(name, label, "ablation of the tree", train, requires=("meshes", *colours))


_STRAIGHT = ("--paths=straight",)
_NEUS, _UNISURF = (*_STRAIGHT, "--field=neus"), (*_STRAIGHT, "--field=unisurf")
_TNSR = ("--field=tnsr",)

_ALL = (
    Method("straight", "Straight (Zip-NeRF)", "main", _STRAIGHT, (), False, "Zip-NeRF"),
    Method(
        "msnerf",
        "MS-NeRF (our fields)",
        "baseline",
        (*_STRAIGHT, "--field=msnerf"),
        (),
        False,
        "MS-NeRF",
    ),
    Method("neus", "NeuS (our fields)", "baseline", _NEUS, requires=("walls",), published="NeuS"),
    Method("unisurf", "UNISURF (our fields)", "baseline", _UNISURF, requires=("walls",)),
    Method("tnsr", "TNSR (our fields)", "baseline", _TNSR, ("meshes", "walls"), published="TNSR"),
    Method(
        "tnsr_true_start",
        "TNSR from the true surface",
        "baseline",
        (*_TNSR, "--surface_start=meshes"),
        ("meshes", "walls"),
    ),
    Method(
        "raydef",
        "Ray deformation (our reading)",
        "baseline",
        (*_STRAIGHT, "--field=raydef"),
        (),
        False,
        "RayDef",
    ),
    Method(
        "raydef_polyline",
        "Ray deformation (polylines)",
        "baseline",
        (*_STRAIGHT, "--field=raydef_polyline"),
        (),
    ),
    Method(
        "rosenerf",
        "RoseNeRF (our fields)",
        "baseline",
        (*_STRAIGHT, "--field=rosenerf"),
        (),
        False,
        "RoseNeRF",
    ),
    Method(
        "splats",
        "Splats (MCMC)",
        "baseline",
        ("--field=splats",),
        (),
        False,
        "Splatfacto",
        evaluate=("--rays_per_pixel=1",),
    ),
    Method("oracle", "Oracle (paper's paths)", "main", _ORACLE, published="Oracle"),
    Method(
        "oracle_as_published",
        "Oracle (as published)",
        "main",
        _RELEASE,
        published="Oracle",
        evaluate=("--rays_per_pixel=1",),
    ),
    Method("tree", "Oracle (path tree)", "main", _TREE),
    Method(
        "tree_backdrop",
        "Oracle (path tree, backdrop)",
        "main",
        (*_TREE, "--far_field=backdrop"),
        ("meshes", "backdrop"),
    ),
    Method("r3f", "R3F (paper's paths)", "main", _ORACLE, ("masks",), True, "R3F"),
    Method("r3f_tree", "R3F (path tree)", "main", _TREE, ("masks",), True),
    _ablated(
        "oracle_distortion",
        "w/o corrected distortion loss",
        "--distortion=everywhere",
        published="w/o corrected distortion loss",
    ),
    _ablated(
        "oracle_no_reflection",
        "w/o first reflection",
        "--paths=paper_no_reflection",
        published="w/o first reflection",
    ),
    _ablated("oracle_no_tir", "w/o TIR", "--paths=paper_no_tir", published="w/o TIR"),
    _ablated("oracle_nerfacto", "w/o Zip-NeRF", "--field=nerfacto", published="w/o Zip-NeRF"),
    _ablated("oracle_2_bends", "no refraction past 2 bends", "--bends=2"),
    _ablated("oracle_4_bends", "no refraction past 4 bends", "--bends=4"),
    _varied("tree_paper_paths", "paper's paths", "--paths=paper"),
    _varied("tree_field", "a learned field inside", "--interior=field"),
    _varied("tree_clear", "nothing inside, no tint", "--interior=clear"),
    _varied(
        "tree_tints_given",
        "absorbing inside, tints given",
        "--interior=absorbing",
        "--tints=given",
        colours=("colours",),
    ),
    _varied(
        "tree_tints_learned",
        "absorbing inside, tints learned",
        "--interior=absorbing",
        "--tints=learned",
    ),
    _varied("tree_cone", "footprint: cone", "--footprint=cone"),
    _varied("tree_differential", "footprint: differential", "--footprint=differential"),
)

METHODS: dict[str, Method] = {method.name: method for method in _ALL}
"""All methods by name, in the order of tables."""

_OF_INSIDE = ("interior", "tints")

FULL: dict[Group, str] = {"ablation of the oracle": "oracle", "ablation of the tree": "tree"}
"""Reference method of each group of ablations; the other groups are compared with each other."""


def same_as(method: Method, preset: str) -> str | None:
    """Returns the method that an ablation equals because its footprint is the preset's."""
    if method.group not in FULL:
        return None
    chosen = _options_of(method).get("footprint")
    size = registry.KINDS[registry.USUAL].sizes[presets.PRESETS[preset].size]
    return FULL[method.group] if chosen == size.footprint else None


def same_inside(method: Method, inside: Mapping[str, str]) -> str | None:
    """Returns the method that an ablation equals because the scene has this interior anyway.

    Args:
      method: ablation.
      inside: values of the options `_OF_INSIDE` that the scene's objects lead to.
    """
    given = _options_of(method)
    chosen = {name: given[name] for name in _OF_INSIDE if name in given}
    return FULL[method.group] if chosen and chosen == inside else None


def _options_of(method: Method) -> dict[str, str]:
    return dict(word.lstrip("-").split("=", 1) for word in method.train)


def evaluation_options(name: str, common: Sequence[str]) -> list[str]:
    """Returns the options that a method is evaluated with: those of all, replaced by its own."""
    own = METHODS[name].evaluate if name in METHODS else ()
    return list(_over(common, own))


def parse(names: Sequence[str]) -> list[Method]:
    """Returns methods by name, in the order of tables.

    Args:
      names: names of methods; `main`, `baselines`, `paper`, `ablations` and `all` are groups.

    Raises:
      ValueError: if the list is empty, or a name is unknown.
    """
    wanted = {name for word in names if word for name in _meaning(word.strip())}
    if not wanted:
        raise ValueError("--methods is empty. Set it, as in --methods=straight,oracle,tree.")
    return [method for method in _ALL if method.name in wanted]


def _meaning(word: str) -> list[str]:
    groups = {
        "main": [method.name for method in _ALL if method.group == "main"],
        "baselines": [method.name for method in _ALL if method.group == "baseline"],
        "paper": [m.name for m in _ALL if m.published and m.group not in FULL],
        "ablations": [method.name for method in _ALL if method.group in FULL] + ["oracle", "tree"],
        "all": list(METHODS),
    }
    if word not in METHODS and word not in groups:
        names = (*METHODS, *groups)
        near = app.did_you_mean(word, names)
        raise ValueError(
            f"There is no method {word!r} for --methods.{near} Choose from {', '.join(names)}."
        )
    return groups.get(word, [word])
