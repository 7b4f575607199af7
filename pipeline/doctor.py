"""``splatmake doctor``: report what the machine has, what is used, and what is missing.

The module imports nothing that could be missing (torch, pydantic, stages).
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.runtime import machine, native, processor, targets
from pipeline.runtime.errors import UserError
from pipeline.runtime.layout import COMMAND, IS_CHECKOUT, install_extra

PYTHON = (3, 11)
LOW_DISK = 10 << 30
LOW_MEMORY = 4 << 30
VULKAN_FOLDERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
VULKAN_LOADER = "libvulkan.so.1"
_INSTALL = "make setup" if IS_CHECKOUT else "pip install splatmake"
# The purpose of each distribution.
NEEDED = {
    "torch": "training",
    "pycolmap": "camera poses",
    "opencv-contrib-python-headless": "features and images",
    "snakemake": "running the stages",
    "pydantic": "the configuration",
}
OPTIONAL = {
    "pillow-heif": "HEIC and HEIF photographs",
    "viser": f"{COMMAND} view",
    "tensorboard": f"{COMMAND} tensorboard",
}


@dataclass(frozen=True)
class Finding:
    """A line of the report.

    Attributes:
        state: The word "used", "there" (not used), "absent" (optional) or "missing" (needed).
        fix: The action that helps, if there is any.
    """

    topic: str
    text: str
    state: str = "used"
    fix: str | None = None


def examine(results: Path = Path("results")) -> list[Finding]:
    """All findings, in the order of the report."""
    return [
        *_python(),
        *_processor(),
        *_compilers(),
        *_libraries(),
        *_memory(),
        *_graphics(),
        *_packages(),
        *_programs(),
        _disk(results),
    ]


def as_text(findings: Sequence[Finding]) -> list[str]:
    """The report's lines."""
    width = max(len(finding.topic) for finding in findings)
    lines = []
    for finding in findings:
        mark = {"missing": "!", "absent": "-", "there": " "}.get(finding.state, "+")
        note = " (not used)" if finding.state == "there" else ""
        lines.append(f"{mark} {finding.topic:<{width}}  {finding.text}{note}")
        if finding.fix:
            lines.append(f"  {'':<{width}}    what to do: {finding.fix}")
    missing = sum(finding.state == "missing" for finding in findings)
    lines.append("")
    lines.append(f"{missing} required components are missing" if missing else "ready to run")
    return lines


def as_data(findings: Sequence[Finding]) -> dict[str, Any]:
    """The report as JSON data."""
    return {"ready": is_ready(findings), "findings": [asdict(finding) for finding in findings]}


def is_ready(findings: Sequence[Finding]) -> bool:
    """Whether everything needed is present."""
    return all(finding.state != "missing" for finding in findings)


def _python() -> list[Finding]:
    text = f"{platform.python_version()} ({sys.executable})"
    required = ".".join(map(str, PYTHON))
    if sys.version_info[:2] < PYTHON:
        fix = f"install Python {required} or newer"
        return [Finding("Python", f"{text}, {required} or newer is needed", "missing", fix)]
    return [Finding("Python", text)]


def _processor() -> list[Finding]:
    cores, usable = os.cpu_count() or 1, machine.usable_cores()
    text = f"{processor.processor_name()}, {processor.architecture()}, {platform.system()}"
    found = [Finding("processor", text), Finding("cores", f"{cores} logical, {usable} used")]
    has = [t.name for t in targets.of_this_architecture() if not t.missing]
    text = f"the processor has {', '.join(has) or 'none of the targets'}"
    try:
        target = targets.usable()[0].name
    except UserError as error:
        return [*found, Finding("instruction set", error.what, "missing", error.fix)]
    forced = f" ({targets.VARIABLE})" if os.environ.get(targets.VARIABLE) else ""
    return [*found, Finding("instruction set", f"{text}; {target} is used{forced}")]


def _compilers() -> list[Finding]:
    chosen, used = os.environ.get("CXX"), native.find_compiler()
    names = dict.fromkeys([*([chosen] if chosen else []), "g++", "clang++"])
    found = []
    for name in names:
        command = name.split()
        topic = f"compiler {name}" + (" ($CXX)" if name == chosen else "")
        if not command or shutil.which(command[0]) is None:
            found.append(Finding(topic, "not found", "absent"))
        else:
            version = native.compiler_identity(command).partition("\n")[0]
            found.append(Finding(topic, version, "used" if command == used else "there"))
    return found


def _libraries() -> list[Finding]:
    """The native libraries. The modules that declare them do not import torch; the others
    import numpy."""
    found = []
    libraries = (("rasterizer", _rasterizer), ("matcher", _matcher), ("stereo", _stereo))
    for topic, declared in libraries:
        try:
            found += [Finding(topic, _describe(library)) for library in declared()]
        except UserError as error:
            found.append(Finding(topic, error.what, "missing", error.fix))
        except ImportError as error:
            found.append(Finding(topic, f"cannot be loaded: {error}", "missing", _INSTALL))
    return found


def _describe(library: native.NativeLibrary) -> str:
    """How the library was built.

    Raises:
        UserError: The library is not built, and there is no compiler.
    """
    variants = targets.usable_variants(library.extensions)
    # As in NativeLibrary.build, other variants are used only without a compiler.
    if native.find_compiler() is not None:
        variants = variants[:1]
    built = next(filter(None, map(library.find, variants)), None)
    if built is not None:
        return f"built for {built.target} by {built.compiler}"
    native.compiler()
    return "not built: compiled when first used"


def _rasterizer() -> Sequence[native.NativeLibrary]:
    from pipeline.render.registry import native_libraries

    return native_libraries()


def _matcher() -> Sequence[native.NativeLibrary]:
    from pipeline.sfm.nearest import LIBRARY

    return [LIBRARY]


def _stereo() -> Sequence[native.NativeLibrary]:
    from pipeline.mvs.patchmatch import LIBRARY

    return [LIBRARY]


def _memory() -> list[Finding]:
    physical, usable = machine.physical_memory(), machine.usable_memory()
    text = f"{physical / 2**30:.1f} GiB, {usable / 2**30:.1f} GiB of it usable"
    low = usable < LOW_MEMORY
    fix = "decrease views.max_long_side_px for large photographs" if low else None
    return [Finding("memory", text, fix=fix)]


def _graphics() -> list[Finding]:
    """Graphics cards, the devices that can train, and which one ``train.device: auto`` takes."""
    query = ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    cards = _output(query).splitlines()
    gpu = [Finding("GPU", f"{card.strip()} (NVIDIA)", "there") for card in cards if card.strip()]
    drivers = _vulkan_drivers()
    vulkan = [Finding("Vulkan", f"drivers {', '.join(drivers)}", "there")] if drivers else []
    none = "none found; everything runs on the processor"
    return [
        *(gpu or ([] if vulkan else [Finding("GPU", none, "absent")])),
        *(vulkan or [Finding("Vulkan", none, "absent", _missing_driver(bool(gpu)))]),
        *_missing_loader(),
        *_training_devices(bool(gpu or vulkan)),
    ]


def _missing_driver(has_nvidia: bool) -> str | None:
    """The fix for a system with wgpu and without the manifest of a Vulkan driver."""
    if sys.platform != "linux" or find_spec("wgpu") is None:
        return None
    if has_nvidia:
        return (
            "the manifest nvidia_icd.json is missing: install all of NVIDIA's driver, or start the "
            "container with NVIDIA_DRIVER_CAPABILITIES=all"
        )
    return (
        "to train on a GPU, install the manufacturer's Vulkan driver (NVIDIA), or apt-get install "
        "mesa-vulkan-drivers (AMD, Intel)"
    )


def _missing_loader() -> list[Finding]:
    """The Vulkan loader if wgpu needs it and it is not installed."""
    if sys.platform != "linux" or find_spec("wgpu") is None:
        return []
    try:
        ctypes.CDLL(VULKAN_LOADER)
    except OSError:
        fix = "to train on a GPU, apt-get install libvulkan1 (Fedora: vulkan-loader)"
        return [Finding("Vulkan loader", f"{VULKAN_LOADER} is not installed", "absent", fix)]
    return []


def _training_devices(has_graphics: bool) -> list[Finding]:
    try:
        from pipeline.render.devices import adapters, choose_device

        chosen = choose_device()
        if find_spec("wgpu") is None:
            fix = f"{install_extra('gpu')}, to train on a GPU" if has_graphics else None
            return [Finding("training", chosen.detail, "absent", fix)]
        found = adapters()
    except (ImportError, UserError) as error:
        return [Finding("training", f"on the processor: {error}", "absent")]
    used = [chosen.device == f"gpu:{adapter.number}" for adapter in found]
    listed = [
        Finding(f"gpu:{adapter.number}", f"{adapter}, {adapter.driver}", "used" if it else "there")
        for adapter, it in zip(found, used, strict=True)
    ]
    return [*listed, Finding("training", chosen.detail)]


def _vulkan_drivers() -> list[str]:
    """The names of the drivers' manifests (ICD files)."""
    listed = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if listed:
        files = [Path(name) for name in listed.split(os.pathsep)]
    else:
        own = Path(os.environ.get("XDG_DATA_HOME") or "~/.local/share").expanduser()
        folders = [*map(Path, VULKAN_FOLDERS), own / "vulkan" / "icd.d"]
        files = [file for folder in folders for file in sorted(folder.glob("*.json"))]
    return list(dict.fromkeys(file.stem for file in files if file.is_file()))


def _packages() -> list[Finding]:
    found = []
    for name, purpose in NEEDED.items():
        version = _version(name)
        if version is None:
            found.append(Finding(name, f"not installed: {purpose}", "missing", _INSTALL))
        else:
            found.append(Finding(name, version))
    for name, purpose in OPTIONAL.items():
        version = _version(name)
        if version is None:
            found.append(Finding(name, f"no {purpose}", "absent", f"pip install {name}"))
        else:
            found.append(Finding(name, f"{version}: {purpose}"))
    return [*found, _lpips()]


def _lpips() -> Finding:
    topic = "LPIPS weights"
    if any(find_spec(name) is None for name in ("numpy", "torch")):
        return Finding(topic, "need torch", "absent")
    from pipeline.metrics.lpips import FETCH, weights_found

    found = {net: len(weights_found(net)) for net in ("vgg", "alex")}
    whole = [net for net, files in found.items() if files == 2]
    if whole:
        return Finding(topic, ", ".join(whole))
    return Finding(topic, "not found: metrics.json has no LPIPS", "absent", FETCH["vgg"])


def _programs() -> list[Finding]:
    path = shutil.which("ffmpeg")
    if path and " libx264 " in _output([path, "-hide_banner", "-encoders"]):
        return [Finding("ffmpeg", f"{path}: videos in H.264")]
    fix = "install ffmpeg with libx264 for videos that all players support"
    return [Finding("ffmpeg", "not found: videos in VP9", "absent", fix)]


def _disk(results: Path) -> Finding:
    place = results.resolve()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    text = f"{free / 2**30:.1f} GiB free for {results}/ (in {place})"
    fix = "large scenes need more: run in a folder on a larger disk (--out)"
    return Finding("disk", text, fix=fix if free < LOW_DISK else None)


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _output(command: list[str]) -> str:
    """The output of a program; empty if it is missing, fails or hangs."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout if done.returncode == 0 else ""
