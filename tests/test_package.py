"""Tests the built packages and their requirements."""

import ast
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from email.message import Message
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import swarmjax

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = {
    canonicalize_name(pin.name): next(iter(pin.specifier)).version
    for pin in map(Requirement, PROJECT["tool"]["uv"]["constraint-dependencies"])
}
DIRECT = [
    Requirement(text)
    for texts in (
        PROJECT["project"]["dependencies"],
        *PROJECT["project"]["optional-dependencies"].values(),
        *PROJECT["dependency-groups"].values(),
    )
    for text in texts
]
# Modules whose name differs from the name of their distribution.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "absl": "absl-py",
    "imageio_ffmpeg": "imageio",
    "orbax": "orbax-checkpoint",
    "warp": "warp-lang",
    "yaml": "pyyaml",
}
USERS = [Requirement(text) for text in PROJECT["project"]["dependencies"]]


def _build(source: Path, target: str, folder: Path) -> Path:
    """Builds a source tree without the network."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)],
        cwd=source,
        check=True,
        capture_output=True,
    )
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _build(ROOT, "sdist", tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(sdist: Path, tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Returns the wheel built from the contents of the sdist."""
    tree = tmp_path_factory.mktemp("tree")
    with tarfile.open(sdist) as archive:
        archive.extractall(tree, filter="data")
    (source,) = tree.iterdir()
    return zipfile.ZipFile(_build(source, "wheel", tmp_path_factory.mktemp("wheel")))


@pytest.fixture(scope="module")
def metadata(wheel: zipfile.ZipFile) -> Message:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return message_from_bytes(wheel.read(name))


def _files(folder: str) -> set[str]:
    """Returns the paths of a folder's files from the repository's root, without `__pycache__`."""
    found = {path for path in (ROOT / folder).rglob("*") if path.is_file()}
    return {str(path.relative_to(ROOT)) for path in found if "__pycache__" not in path.parts}


def test_the_wheel_holds_the_package_and_its_configs_alone(wheel: zipfile.ZipFile) -> None:
    held = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert held == _files("swarmjax") | {f"swarmjax/{name}" for name in _files("configs")}


def test_the_wheel_says_that_it_is_typed(wheel: zipfile.ZipFile) -> None:
    assert wheel.read("swarmjax/py.typed") == b""


def test_the_wheel_has_the_console_script(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert "swarmjax = swarmjax.shell.entry:main" in wheel.read(name).decode().splitlines()


def test_the_wheel_asks_for_ranges_and_not_for_the_pins(metadata: Message) -> None:
    asked = [Requirement(text) for text in metadata.get_all("Requires-Dist", [])]
    assert {str(each.specifier) for each in asked if each.name == "mujoco"} == {"==3.17.*"}
    exact = [each.name for each in asked for one in each.specifier if one.operator == "=="]
    assert set(exact) == {"mujoco", "mujoco-mjx", "warp-lang"}


def test_a_version_stands_in_one_form_everywhere(metadata: Message) -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert metadata["Version"] == swarmjax.__version__ == cited["version"]


def test_the_package_says_what_its_citation_says() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = PROJECT["project"]
    assert project["authors"] == cited["authors"]
    assert project["keywords"] == cited["keywords"]
    assert project["license"] == cited["license"]


@pytest.mark.parametrize("asked", DIRECT, ids=str)
def test_what_is_asked_for_is_pinned_within_its_range(asked: Requirement) -> None:
    assert asked.specifier.contains(PINS[canonicalize_name(asked.name)])


@pytest.mark.parametrize("asked", USERS, ids=str)
def test_a_range_has_both_ends(asked: Requirement) -> None:
    operators = {each.operator for each in asked.specifier}
    assert operators in ({">=", "<"}, {"=="})


@pytest.mark.parametrize(
    ("name", "called"),
    [
        ("chex", "Chex"),
        ("flax", "Flax"),
        ("jax", "JAX"),
        ("numpy", "NumPy"),
        ("optax", "Optax"),
        ("orbax-checkpoint", "Orbax checkpoint"),
    ],
)
def test_the_page_names_the_oldest_and_the_newest_version(name: str, called: str) -> None:
    page = (ROOT / "docs" / "install.md").read_text().splitlines()
    (row,) = (line for line in page if line.startswith(f"| {called} |"))
    oldest, newest = (Version(cell.strip()) for cell in row.split("|")[2:4])
    (asked,) = (each for each in USERS if each.name == name)
    ends = {each.operator: Version(each.version) for each in asked.specifier}
    assert ends[">="] == oldest <= newest < ends["<"]


def _imported(path: Path) -> set[str]:
    """Returns the top-level modules that a file imports."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = [each.name for node in nodes if isinstance(node, ast.Import) for each in node.names]
    names += [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.partition(".")[0] for name in names}


def test_everything_that_is_imported_is_asked_for() -> None:
    """Checks that every imported package is a direct dependency.

    An import breaks if only a transitive dependency requires its package and later drops it.
    """
    imported = set().union(*map(_imported, (ROOT / "swarmjax").rglob("*.py")))
    names = {DISTRIBUTIONS.get(name, name) for name in imported - sys.stdlib_module_names}
    asked = {canonicalize_name(each.name) for each in DIRECT} | {"swarmjax"}
    assert {canonicalize_name(name) for name in names} - asked == set()


@pytest.mark.slow
def test_an_installed_wheel_trains_and_judges() -> None:
    """Runs `.ci/versions.py` with the newest versions, which needs the package index."""
    words = [sys.executable, str(ROOT / ".ci" / "versions.py"), "newest"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
