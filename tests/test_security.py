"""Nothing from a data file is executed, unpickled or unpacked beyond bounds; pages load nothing."""

import ast
import html.parser
import io
import pickle
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import PIL.Image
import pytest

from experiments.dataset import check_page
from refref_jax import atomic_files, metrics
from refref_jax.data import image_files, meshes
from refref_jax.render import checkpoint_io
from tests.laws import syntax
from tests.laws.conventions import holds_of_all
from tests.processes.command import ROOT

_MODULES = sorted((*(ROOT / "refref_jax").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")))

# The stored mesh of an object is the project's own.
_READS_ARRAYS = {"refref_jax/atomic_files.py", "experiments/dataset/objects/monkey.py"}


class _Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self._path = path

    def __reduce__(self):
        return Path.touch, (self._path,)


def _calls(path):
    for node in syntax.nodes(path):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), {each.arg: each.value for each in node.keywords}


@holds_of_all(_MODULES)
def test_no_module_executes_or_unpickles_what_it_reads(path):
    name = path.relative_to(ROOT).as_posix()
    for function, options in _calls(path):
        assert function not in ("eval", "exec", "os.system", "os.popen", "yaml.load")
        assert function.partition(".")[0] not in ("marshal", "shelve", "dill")
        assert function not in ("pickle.load", "pickle.loads", "pickle.Unpickler")
        assert "shell" not in options
        if function == "torch.load":
            assert ast.unparse(options["weights_only"]) == "True"
        if function == "np.load":
            assert ast.unparse(options["allow_pickle"]) == "False" and name in _READS_ARRAYS


def test_the_payload_would_work(tmp_path):
    pickle.loads(pickle.dumps(_Payload(tmp_path / "touched")))
    assert (tmp_path / "touched").exists()


@pytest.mark.parametrize("read", [checkpoint_io.load_scene, metrics.read_lpips])
@pytest.mark.parametrize("packed", [True, False])
def test_a_pickle_among_arrays_is_refused(tmp_path, read, packed):
    content = np.array([_Payload(tmp_path / "touched")], object)
    path = tmp_path / "geometry.npz"
    if packed:
        np.savez(path, index_inside=content)
    else:
        path.write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=r"geometry\.npz"):
        read(tmp_path if read is checkpoint_io.load_scene else path)
    assert not (tmp_path / "touched").exists()


def test_a_pickle_of_pytorch_is_refused(tmp_path):
    torch = pytest.importorskip("torch")
    from experiments import convert_lpips

    path = tmp_path / "weights.pth"
    torch.save({"features.0.bias": _Payload(tmp_path / "touched")}, path)
    with pytest.raises(ValueError, match="more than tensors"):
        convert_lpips.read_state_dict(path)
    assert not (tmp_path / "touched").exists()


def _bomb(path, size):
    """An `.npz` file of zeros, a thousandth of its unpacked size."""
    header = io.BytesIO()
    np.lib.format.write_array_header_2_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (size,)}
    )
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("index_inside.npy", "w", force_zip64=True) as file,
    ):
        file.write(header.getvalue())
        for _ in range(size >> 20):
            file.write(bytes(1 << 20))


def test_arrays_that_are_packed_too_densely_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(atomic_files, "_ALWAYS_READ", 1 << 20)
    _bomb(tmp_path / "geometry.npz", 4 << 20)
    with pytest.raises(ValueError, match=r"geometry\.npz .*would unpack to 4194432 bytes"):
        checkpoint_io.load_scene(tmp_path)
    monkeypatch.setattr(atomic_files, "_ALWAYS_READ", 8 << 20)
    assert len(atomic_files.read_arrays(tmp_path / "geometry.npz")["index_inside"]) == 4 << 20


def test_an_array_that_declares_more_than_there_is_is_refused(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_2_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 50,)}
    )
    with zipfile.ZipFile(tmp_path / "geometry.npz", "w") as archive:
        archive.writestr("index_inside.npy", header.getvalue())
    with pytest.raises(ValueError, match=r"geometry\.npz"):
        checkpoint_io.load_scene(tmp_path)


def test_a_mesh_opens_no_texture(tmp_path, monkeypatch):
    corners = ["0 0 0 0 0", "1 0 0 0 1", "0 1 0 1 0"]
    lines = ["ply", "format ascii 1.0", "comment TextureFile ../secret.png", "element vertex 3"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "s", "t")]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "meshes").mkdir()
    path = tmp_path / "meshes" / "a_glass.ply"
    path.write_text("\n".join([*lines, *corners, "3 0 1 2"]) + "\n")
    PIL.Image.new("RGB", (2, 2)).save(tmp_path / "secret.png")
    opened = []
    monkeypatch.setattr(PIL.Image, "open", lambda *arguments, **options: opened.append(arguments))
    assert len(meshes.read_mesh(path)[1]) == 1 and not opened


def test_no_program_is_started_for_an_image(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n")
    monkeypatch.setattr(subprocess, "Popen", lambda *arguments, **options: pytest.fail("started"))
    for read in (image_files.read_rgb, image_files.read_mask, image_files.read_size):
        with pytest.raises(ValueError, match="cannot be read as an image"):
            read(path)


_READ_WITHIN = """
import resource, sys
from refref_jax.data import image_files
from refref_jax import atomic_files
resource.setrlimit(resource.RLIMIT_DATA, (2 << 30, 2 << 30))
read = {"png": image_files.read_rgb, "npz": atomic_files.read_arrays}[sys.argv[1][-3:]]
try:
    print(read(__import__("pathlib").Path(sys.argv[1])).shape)
except ValueError as error:
    print(error)
"""


def _read_within(path):
    words = [sys.executable, "-c", _READ_WITHIN, str(path)]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.slow
def test_bombs_end_within_two_gibibytes(tmp_path):
    _bomb(tmp_path / "a.npz", 8 << 30)
    assert "would unpack to" in _read_within(tmp_path / "a.npz")
    with warnings.catch_warnings(action="ignore"):
        for side, told in ((8192, "(8192, 8192, 3)"), (9000, "9000 x 9000"), (20_000, "pixels")):
            image = PIL.Image.new("RGBA" if side == 8192 else "L", (side, side))
            image.save(tmp_path / "a.png", compress_level=1)
            assert told in _read_within(tmp_path / "a.png")


class _Elements(html.parser.HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))


def test_the_page_of_a_check_escapes_names_and_loads_nothing():
    odd = "a\"b'<script>alert(1)</script>&amp;"
    report = check_page.SceneReport(odd, [odd], [odd], [])
    text = check_page.write_page([report], title=odd)
    found = _Elements(text).found
    assert "script" not in {tag for tag, _ in found} and text.count("&lt;script&gt;") >= 4
    assert not {"src", "href", "onload"} & {name for _, given in found for name in given}
