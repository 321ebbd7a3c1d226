"""Checks that the C files build without a warning, agree with NumPy, and fit on the robot."""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import policies
import pytest
from policies import saved, several

from swarmjax import epuck, outputs, policy
from swarmjax.export import c as export_c
from swarmjax.policy import Policy
from swarmjax.ppo.config import AlgoConfig
from swarmjax.sim import drive
from swarmjax.sim.config import RobotConfig
from swarmjax.task import observation

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow",
          "-Wconversion", "-Wdouble-promotion")  # fmt: skip
CORTEX_M4F = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
HIDDEN = AlgoConfig().hidden_sizes

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs Debian's package gcc")
needs_arm = pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None,
    reason="needs Debian's packages gcc-arm-none-eabi and libnewlib-arm-none-eabi",
)


def _written(folder: Path, trained: Policy) -> Path:
    outputs.write({folder / name: each for name, each in export_c.render(trained).items()})
    return folder


def _run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)


@needs_gcc
@pytest.mark.parametrize("learners", [1, 3])
@pytest.mark.parametrize("activation", ["tanh", "relu", "swish"])
def test_it_builds_without_warnings_and_its_self_test_passes(
    activation: str, learners: int, tmp_path: Path
) -> None:
    given = policies.arrays(hidden=(16, 7), learners=learners)
    trained = saved(tmp_path / "p.npz", given, activation=activation, **several(learners))
    folder = _written(tmp_path / "c", trained)
    built = _run(folder, "gcc", *STRICT, "policy.c", "policy_test.c", "-lm", "-o", "self_test")
    assert (built.returncode, built.stdout, built.stderr) == (0, "", "")
    assert _run(folder, "./self_test").returncode == 0


@needs_gcc
@pytest.mark.parametrize("learners", [1, 3])
def test_one_that_remembers_builds_without_warnings_and_its_self_test_passes(
    learners: int, tmp_path: Path
) -> None:
    changed = ("(recalled[i] - fresh)", "(recalled[i])")
    plain = policies.arrays(hidden=(16, 7), learners=learners)
    given, said = policies.recalling(plain, 5, **several(learners))
    folder = _written(tmp_path / "c", saved(tmp_path / "p.npz", given, **said))
    built = _run(folder, "gcc", *STRICT, "policy.c", "policy_test.c", "-lm", "-o", "self_test")
    assert (built.returncode, built.stdout, built.stderr) == (0, "", "")
    assert _run(folder, "./self_test").returncode == 0
    source = (folder / "policy.c").read_text()
    assert source.count(changed[0]) == 1
    (folder / "policy.c").write_text(source.replace(*changed))
    _run(folder, "gcc", "-std=c99", "policy.c", "policy_test.c", "-lm", "-o", "self_test")
    assert _run(folder, "./self_test").returncode != 0


@pytest.mark.parametrize(("said", "holds"), [({"arrival": "latch"}, 0), ({"arrival": "hold"}, 1)])
def test_the_header_says_whether_the_robot_is_to_stop(
    said: dict, holds: int, tmp_path: Path
) -> None:
    trained = saved(tmp_path / "p.npz", task=policies.meta()["task"] | said)
    header = export_c.render(trained)["policy.h"].decode()
    assert f"#define POLICY_HOLDS {holds} " in header


@needs_gcc
def test_the_self_test_notices_a_changed_weight(tmp_path: Path) -> None:
    folder = _written(tmp_path / "c", saved(tmp_path / "p.npz"))
    source = (folder / "policy.c").read_text()
    bias = re.search(r"BIAS_2\[POLICY_LEARNERS\]\[2\] = \{\n\{\n +(\S+)f,", source)
    assert bias is not None
    changed = source.replace(f"{bias[1]}f", f"{float(bias[1]) + 1e-4!r}f")
    (folder / "policy.c").write_text(changed)
    _run(folder, "gcc", "-std=c99", "policy.c", "policy_test.c", "-lm", "-o", "self_test")
    assert _run(folder, "./self_test").returncode == 1  # the first case fails


@needs_gcc
def test_make_builds_and_runs_the_self_test(tmp_path: Path) -> None:
    if shutil.which("make") is None:
        pytest.skip("needs Debian's package make")
    folder = _written(tmp_path / "c", saved(tmp_path / "p.npz"))
    made = _run(folder, "make", "test")
    assert (made.returncode, made.stderr) == (0, "")
    assert made.stdout.endswith("policy_test: all actions agree\n")


@needs_gcc
def test_from_quantities_to_wheel_speeds(tmp_path: Path) -> None:
    layout = policies.observed("webots")
    trained = saved(tmp_path / "p.npz", observation=layout)
    folder = _written(tmp_path / "c", trained)
    _run(folder, "gcc", "-std=c99", "-O2", "-shared", "-fPIC", "policy.c", "-lm", "-o", "p.so")
    library = ctypes.CDLL(str(folder / "p.so"))
    draw = np.random.default_rng(0)

    def call(function: str, given: np.ndarray, size: int) -> np.ndarray:
        found = np.zeros((len(given), size), np.float32)
        for row, result in zip(np.ascontiguousarray(given), found, strict=True):
            pointers = (ctypes.c_void_p(array.ctypes.data) for array in (row, result))
            getattr(library, function)(*pointers)
        return found

    quantity = draw.uniform(0, 500, (50, observation.SIZE)).astype(np.float32)
    expected = (quantity - np.float32(layout["offset"])) / np.float32(layout["scale"])
    # C does the same operations on the same float32 numbers, here and in the two checks below.
    np.testing.assert_array_equal(call("policy_observe", quantity, observation.SIZE), expected)
    action = draw.normal(size=(50, 2)).astype(np.float32)
    command = policy.command(trained, action)
    np.testing.assert_array_equal(call("policy_command", action, 2), command)
    robot = drive.from_config(RobotConfig())
    wheels = drive.wheel_speeds(command, robot, np)
    assert (np.abs(wheels) == np.float32(epuck.MAX_WHEEL_SPEED)).any()  # some speeds are clamped
    np.testing.assert_allclose(call("policy_wheel_speeds", command, 2), wheels, rtol=1e-6)


@needs_arm
def test_it_fits_on_a_cortex_m4f(tmp_path: Path) -> None:
    given = policies.arrays(hidden=HIDDEN)
    folder = _written(tmp_path / "c", saved(tmp_path / "p.npz", given))
    gcc = ("arm-none-eabi-gcc", *CORTEX_M4F, *STRICT)
    built = _run(folder, *gcc, "-fstack-usage", "-c", "policy.c", "-o", "policy.o")
    assert (built.returncode, built.stderr) == (0, "")
    listed = _run(folder, "arm-none-eabi-size", "policy.o").stdout.splitlines()[1].split()
    text, data, bss = (int(word) for word in listed[:3])
    assert (data, bss) == (0, 0)  # RAM is used only on the stack.
    # The network has two layers of 64 units and 2 outputs. The normaliser and the scaling have two
    # numbers per input each.
    size = observation.SIZE
    floats = size * 64 + 64 + 64 * 64 + 64 + 64 * 2 + 2 + 2 * size + 2 * size
    assert 4 * floats < text < 4 * floats + 1024
    stack = (folder / "policy.su").read_text()
    used = {line.split()[0].split(":")[-1]: int(line.split()[1]) for line in stack.splitlines()}
    assert 2 * 64 * 4 <= used["policy_action"] < 2 * 64 * 4 + 128
    # The whole self-test links with newlib, and the policy calls no double-precision function of
    # libm.
    whole = _run(
        folder, *gcc, "--specs=nosys.specs", "policy.c", "policy_test.c", "-lm", "-o", "t.elf"
    )
    assert (whole.returncode, whole.stderr) == (0, "")
    needed = _run(folder, "arm-none-eabi-nm", "--undefined-only", "policy.o").stdout.split()
    assert set(needed) - {"U"} == {"tanhf"}


def test_the_layout_stands_in_the_header(tmp_path: Path) -> None:
    trained = saved(tmp_path / "p.npz")
    header = export_c.render(trained)["policy.h"].decode()
    assert f'#define POLICY_DIGEST "{trained.digest}"' in header
    names = re.findall(r"^ \*   \[(\d+)\] (\S+) +(\S+) +offset (\S+), scale (\S+)$", header, re.M)
    layout = trained.meta["observation"]
    assert [(name, unit) for _, name, unit, *_ in names] == list(
        zip(layout["names"], layout["units"], strict=True)
    )
    assert re.search(r"^ \*   turn_rate +rad/s +-3\.14 to 3\.14$", header, re.M)


def test_numbers_are_written_so_that_c_reads_the_same() -> None:
    draw = np.random.default_rng(0)
    bits = draw.integers(0, 2**32, 2000, dtype=np.uint32).view(np.float32)
    bits = np.append(bits[np.isfinite(bits)], np.float32([0, -0.0, 1, 1e-45, 3.4028235e38]))
    for value in bits:
        text = export_c.number(value)
        assert re.fullmatch(r"-?\d\.\d+e[+-]\d+f", text)  # a float constant of C99
        assert np.float32(text[:-1]).tobytes() == value.tobytes()
