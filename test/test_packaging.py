# SPDX-License-Identifier: Apache-2.0
"""What pip makes of the source tree: a wheel that needs no ROS, and says what it needs."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from email.message import Message
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("robocal_ros", "config", "launch", "resource", "requirements")
FILES = ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built as `pip install .` does, from a copy, with the setuptools that is here."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for part in PARTS:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / part, source / part, ignore=ignored)
    for file in FILES:
        shutil.copy(ROOT / file, source / file)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    alone = ["--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", str(out)]
    subprocess.run([*pip, *alone, str(source)], check=True, cwd=out)
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as file:
        (name,) = (n for n in file.namelist() if n.endswith(".dist-info/METADATA"))
        return Parser().parsestr(file.read(name).decode())


@pytest.mark.ros
def test_the_installed_demo_has_all_that_it_imports(tmp_path: Path) -> None:
    """Copied as colcon does without --symlink-install; none of it may come from this checkout."""
    made = tmp_path / "install"
    copy = [sys.executable, "setup.py", "-q", "install_data", "--install-dir", str(made)]
    source = tmp_path / "source"
    for part in (*PARTS, "docs/schemas", "bags", "bench"):
        shutil.copytree(ROOT / part, source / part, ignore=shutil.ignore_patterns("__pycache__"))
    for file in FILES:
        shutil.copy(ROOT / file, source / file)
    subprocess.run(copy, cwd=source, check=True, capture_output=True)
    shutil.rmtree(source)
    (made / "lib" / "robocal_ros").mkdir(parents=True)
    share = made / "share" / "robocal_ros"
    asked = f"""
import sys
sys.path.insert(0, {str(share / "demo" / "bags")!r})
import demo
from bench.live.cell import PARAMETERS
from bench.startup import EXECUTABLES
found = [m.__file__ for name, m in sys.modules.items() if name.split(".")[0] == "bench"]
print(all(file.startswith({str(share)!r}) for file in found), len(found), EXECUTABLES, PARAMETERS)
"""
    path = f"{made}{os.pathsep}{os.environ['AMENT_PREFIX_PATH']}"
    given = os.environ | {"AMENT_PREFIX_PATH": path}
    done = subprocess.run(
        [sys.executable, "-c", asked],
        cwd=tmp_path, env=given, capture_output=True, text=True, check=True,
    )  # fmt: skip
    ours, count, executables, parameters = done.stdout.split()
    assert ours == "True"
    assert int(count) > 10
    assert executables == str(made / "lib" / "robocal_ros")
    assert Path(parameters).name == "kr150_shift.yaml"
    assert (share / "bags" / "demo_shift.mcap").is_file()
    assert (share / "schemas" / "common.json").is_file()


def pins(file: str) -> dict[str, str]:
    text = (ROOT / "requirements" / file).read_text()
    return dict(re.findall(r"^([\w.-]+)==([\w.]+)", text, re.MULTILINE))


def test_what_it_needs_is_declared_from_the_oldest_that_is_tested(metadata: Message) -> None:
    needed = [str(line) for line in metadata.get_all("Requires-Dist", [])]
    own = [line for line in needed if "extra ==" not in line and line != "setuptools"]
    names = {re.split(r"[<>=]", line)[0]: line for line in own}
    core, floor = pins("core.txt"), pins("floor.txt")
    assert set(names) == set(core)
    for name, line in names.items():
        oldest = re.search(r">=([\w.]+)", line)
        assert oldest is not None
        text = (ROOT / "requirements" / "floor.txt").read_text()
        assert f"{name}=={oldest[1]}" in text  # which `make test-floor` runs with
        newest = re.search(r"<(\d+)", line)
        assert newest is not None
        assert int(newest[1]) == int(core[name].split(".")[0]) + 1
        assert name in floor
    extras = {str(extra) for extra in metadata.get_all("Provides-Extra", [])}
    assert extras == {"cluster", "completion", "dev", "panel", "plc"}


def test_it_lays_no_script_over_pips_own(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
    data = [name.split(".data/data/")[1] for name in names if ".data/data/" in name]
    assert data
    assert all(name.startswith("share/robocal_ros/") for name in data)
    assert "share/robocal_ros/config/robots/ur10.yaml" in data


def test_its_command_works_without_ros(wheel: Path, tmp_path: Path) -> None:
    """In a venv that has the libraries of this one and nothing of ours; ROS cannot be imported."""
    made = tmp_path / "venv"
    venv.create(made, with_pip=False)
    python, site = made / "bin" / "python", next((made / "lib").glob("python*")) / "site-packages"
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    none = "".join(f"import sys; sys.modules[{name!r}] = None\n" for name in ("rclpy", "std_msgs"))
    (site / "libraries.pth").write_text("\n".join(libraries) + "\n" + none)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    subprocess.run([*pip, "install", "--quiet", "--no-deps", str(wheel)], check=True)
    # Its kernels are not those that are kept for the tests: they run as Python.
    given = {"PATH": os.defpath, "HOME": str(tmp_path), "NUMBA_DISABLE_JIT": "1"}
    asked = ["fk", "--robot", "ur10", "--joints-deg", "0,0,0,0,0,0", "--json"]
    done = subprocess.run(
        [made / "bin" / "robocal", *asked],
        env=given, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert '"robot": "UR10"' in done.stdout
    here = f"import robocal_ros; print(robocal_ros.__file__.startswith({str(made)!r}))"
    said = subprocess.run(
        [python, "-c", here], env=given, cwd=tmp_path, capture_output=True, text=True
    )
    assert said.stdout == "True\n"


def test_libraries_that_several_wheels_bring_are_one_file(tmp_path: Path) -> None:
    """What pip takes away with one wheel stays for the others; what differs is left."""
    spec = importlib.util.spec_from_file_location("mend", ROOT / "tools" / "mend_wheels.py")
    assert spec is not None
    assert spec.loader is not None
    mend = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(mend)
    one, two, other = (tmp_path / f"{name}.libs" / "libx.so.1" for name in ("a", "b", "c"))
    for path, text in ((one, "x"), (two, "x"), (other, "y")):
        path.parent.mkdir()
        path.write_text(text)
    assert mend.share(tmp_path) == 1
    assert one.samefile(two)
    assert mend.share(tmp_path) == 0
    one.unlink()
    assert (two.read_text(), other.read_text()) == ("x", "y")
