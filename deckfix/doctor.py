"""``deckfix doctor``: what is installed, and what is wrong with it."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path

from deckfix._version import __version__
from estimation.codecache import cache_home, writable

PACKAGES = ("estimation", "vision", "logs", "simulation", "deckfix")
"""The top-level packages of this distribution."""

REQUIRED = (
    "numpy", "scipy", "filterpy", "opencv-python-headless", "pymavlink", "mcap", "mcap-ros2-support",
    "msgspec", "click", "rich", "joblib", "plotly", "pygeomag",
)  # fmt: skip
OPTIONAL = {
    "numba": "the compiled engines of filter and detector (deckfix[fast])",
    "pyulog": "importing PX4 .ulg (deckfix[px4])",
    "foxglove-sdk": "watching a flight live in Foxglove (deckfix[live])",
    "distributed": "fleets on a Dask cluster (deckfix[cluster])",
    "av": "exact times of a video's frames; OpenCV reads them without it (deckfix[video])",
    "pandas": "Result.to_pandas()",
    "pyarrow": "export --format parquet",
}


@dataclass(frozen=True, slots=True)
class Check:
    """One thing looked at: its name, what was found, and what to do where that is wrong."""

    name: str
    found: str
    remedy: str = ""

    @property
    def good(self) -> bool:
        """True where nothing needs to be done."""
        return not self.remedy


def examine() -> tuple[str, bool]:
    """Return the report of the installation as text, and whether all is well."""
    checks = [*_software(), *_names(), *_places(), _clock()]
    lines = []
    for c in checks:
        lines.append(
            f"{'ok   ' if c.good else 'WRONG'} {c.name}: {c.found}" + ("" if c.good else f"; {c.remedy}")
        )
    healthy = all(c.good for c in checks)
    lines.append("all is well" if healthy else "something is wrong: see above")
    return "\n".join(lines), healthy


def _software() -> Iterable[Check]:
    yield Check("deckfix", f"{__version__} in {Path(__file__).resolve().parent}")
    python = (
        f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    )
    new_enough = sys.version_info >= (3, 11)
    yield Check("python", python, "" if new_enough else "install Python 3.11 or later")
    for name in REQUIRED:
        version = _version(name)
        yield Check(name, version or "missing", "" if version else f"pip install '{name}'")
    yield _opencv()
    filterpy = _version("filterpy")
    if filterpy and int(filterpy.split(".")[0]) < 2:
        yield Check(
            "filterpy", f"{filterpy} returns wrong Mahalanobis distances", "pip install 'filterpy>=2,<3'"
        )
    for name, use in OPTIONAL.items():
        yield Check(name, _version(name) or f"not installed; needed for {use}")


def _opencv() -> Check:
    """Check that OpenCV can be loaded, which a second distribution of it or a missing library prevents."""
    try:
        import cv2

        said = str(cv2.getBuildInformation())
    except Exception as error:  # a broken installation raises whatever its loader does
        return Check(
            "OpenCV", f"cannot be loaded ({error})", "pip install --force-reinstall opencv-python-headless"
        )
    reads = any("FFMPEG" in line and "YES" in line for line in said.splitlines())
    without = "" if reads or _version("av") else "; it reads no video, install deckfix[video] for that"
    return Check("OpenCV", f"{cv2.__version__}{without}")


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _names() -> Iterable[Check]:
    """Check that the names ``estimation``, ``vision``, ``logs``, ``simulation`` mean this product's
    packages.
    """
    home = Path(__file__).resolve().parent.parent
    owners = metadata.packages_distributions()
    for name in PACKAGES:
        others = sorted({o for o in owners.get(name, []) if o.lower() != "deckfix"})
        if others:
            yield Check(
                name,
                f"is also installed by {', '.join(others)}",
                f"uninstall {others[0]}, or use its own venv",
            )
            continue
        place = _origin(name)
        if place is None:
            yield Check(name, "cannot be imported", "install deckfix again")
        elif place.parent != home:
            yield Check(name, f"is shadowed by {place}", "rename that folder, or start from another one")
        else:
            yield Check(name, str(place))


def _origin(name: str) -> Path | None:
    """Return the folder (or file) that an import of this name would take."""
    try:
        spec = util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if spec.origin and Path(spec.origin).name == "__init__.py":
        return Path(spec.origin).resolve().parent
    if spec.origin and spec.origin != "namespace":
        return Path(spec.origin).resolve()
    places = list(spec.submodule_search_locations or [])
    return Path(places[0]).resolve() if places else None


def _places() -> Iterable[Check]:
    for name, folder in (("this folder", Path.cwd()), ("temporary files", Path(tempfile.gettempdir()))):
        good = _writable(folder)
        yield Check(name, f"{folder} {'is' if good else 'is not'} writable", "" if good else "choose another")
    if _version("numba"):
        cache = cache_home()
        if writable(cache):
            yield Check("compiled code", f"is kept in {cache}")
        else:
            yield Check(
                "compiled code",
                f"cannot be kept in {cache}",
                "set XDG_CACHE_HOME to a folder that can be written",
            )


def _writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _clock() -> Check:
    now = time.time()
    newest = max(p.stat().st_mtime for p in Path(__file__).resolve().parent.glob("*.py"))
    wrong = now < newest - 86_400
    text = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(now))
    return Check("clock", text, "set the computer's clock: it is before the installed files" if wrong else "")
