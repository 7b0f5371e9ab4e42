"""What is built and installed: the wheel, the import contract, and that git sees every package."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("estimation", "vision", "logs", "simulation", "deckfix")


def run(*command: str | Path, cwd: Path = ROOT, timeout: float = 280.0) -> subprocess.CompletedProcess[str]:
    """Run a command, and show its output where it fails."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(c) for c in command], cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False,
        env=environment, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy of the sources."""
    place = tmp_path_factory.mktemp("build")
    source = place / "source"
    source.mkdir()
    for name in (*PACKAGES, "pyproject.toml", "README.md", "LICENSE"):
        origin = ROOT / name
        if origin.is_dir():
            shutil.copytree(origin, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(origin, source / name)
    if importlib.util.find_spec("hatchling") is None:
        isolated = [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "-w",
            str(place),
            str(source),
        ]
        done = subprocess.run(isolated, capture_output=True, text=True, timeout=280, check=False)
        if done.returncode and "No matching distribution found for hatchling" in done.stderr:
            pytest.skip("no package registry: the wheel's build backend cannot be fetched")
        assert done.returncode == 0, done.stderr
    else:
        run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", place, cwd=source)
    return next(place.glob("*.whl"))


def test_the_wheel_holds_the_packages_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
    tops = {name.split("/")[0] for name in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == set(PACKAGES)
    for package in PACKAGES:
        assert f"{package}/__init__.py" in names
        assert f"{package}/py.typed" in names
    for asset in ("deckfix/report.css", "deckfix/report.js", "simulation/scenarios/landing_2026_06.toml"):
        assert asset in names
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert not any("__pycache__" in name or name.startswith("tests") for name in names)


def test_the_wheel_runs_without_the_sources(wheel: Path, tmp_path: Path) -> None:
    """The wheel is unpacked where only it is found; its dependencies are those of this environment."""
    place = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as file:
        file.extractall(place)
    code = (
        f"import sys; sys.path.insert(0, {str(place)!r})\n"
        "import deckfix.cli, logs, estimation, simulation, vision\n"
        f"assert deckfix.__file__.startswith({str(place)!r}), deckfix.__file__\n"
        "sys.exit(deckfix.cli.main(['simulate', 'landing_2026_06', '-o', 'f.mcap']))"
    )
    run(sys.executable, "-c", code, cwd=tmp_path)
    assert (tmp_path / "f.mcap").stat().st_size > 100_000


@pytest.mark.nightly
def test_the_wheel_installs_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    folder = tmp_path / "venv" / "bin"
    run(folder / "python", "-m", "pip", "install", "--quiet", wheel)
    assert "deckfix" in run(folder / "deckfix", "--version", cwd=tmp_path).stdout
    run(folder / "deckfix", "doctor", cwd=tmp_path)
    run(folder / "deckfix", "demo", "-o", tmp_path / "demo", cwd=tmp_path)
    assert (tmp_path / "demo" / "report.html").stat().st_size > 1_000_000


def test_imports_point_downwards() -> None:
    tool = Path(sys.executable).with_name("lint-imports")
    if not tool.exists():
        pytest.skip("import-linter is not installed: pip install 'deckfix[lint]'")
    assert "0 broken" in run(tool, "--no-cache").stdout


def test_git_sees_every_source_file() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("this is no git checkout")
    sources = [str(p.relative_to(ROOT)) for package in PACKAGES for p in (ROOT / package).rglob("*.py")]
    assert any(s.startswith("logs/") for s in sources)
    ignored = subprocess.run(
        ["git", "check-ignore", "--stdin"], cwd=ROOT, input="\n".join(sources), text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    assert ignored.stdout == ""


def test_every_package_is_typed_and_named_in_the_project() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert tuple(project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]) == PACKAGES
    assert project["project"]["scripts"] == {"deckfix": "deckfix.cli:main"}
    for package in PACKAGES:
        assert (ROOT / package / "py.typed").exists()
