"""Measures a GPU and many cores in one command of less than nine minutes.

    python -m benchmarks.card PACK --json record.json

``PACK`` is a folder of ``benchmarks.card.pack``. Its wheels and Vulkan loader are installed into a
folder inside it, not into the system. This module needs none of them: it installs them, and then
runs itself in an environment that has them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

INSTALLED = "installed"  # The folder inside the pack.
MARK = "SPLATMAKE_CARD_INSTALLED"
#: NVIDIA's Vulkan driver. Containers often have the library without the manifest.
NVIDIA = ("libGLX_nvidia.so.0", "libEGL_nvidia.so.0")
MANIFESTS = ("/etc/vulkan/icd.d", "/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")


def install(pack: Path) -> dict[str, str]:
    """Install the pack; returns the environment in which its packages are found.

    Raises:
        subprocess.CalledProcessError: pip or dpkg fails.
    """
    folder = pack / INSTALLED
    python, system = folder / "python", folder / "system"
    if not python.exists():
        wheels = [str(file) for file in sorted((pack / "wheels").glob("*.whl"))]
        made = folder / "python.part"
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
        subprocess.run([*pip, "--target", str(made), *wheels], check=True)
        made.rename(python)
    for file in sorted((pack / "loader").glob("*.deb")):
        subprocess.run(["dpkg", "-x", str(file), str(system)], check=True)
    environment = dict(os.environ)
    _prepend(environment, "PYTHONPATH", [str(python)])
    _prepend(environment, "PATH", [str(python / "bin")])
    folders = [system / "usr/lib/x86_64-linux-gnu", system / "lib/x86_64-linux-gnu"]
    # The system's own libraries come first where it has them.
    environment["LD_LIBRARY_PATH"] = os.pathsep.join(
        filter(None, [environment.get("LD_LIBRARY_PATH", ""), *map(str, folders)])
    )
    manifest = _nvidia_manifest(folder)
    if manifest is not None:
        environment["VK_DRIVER_FILES"] = environment["VK_ICD_FILENAMES"] = str(manifest)
    environment[MARK] = "1"
    return environment


def _prepend(environment: dict[str, str], name: str, paths: list[str]) -> None:
    environment[name] = os.pathsep.join([*paths, *filter(None, [environment.get(name)])])


def _nvidia_manifest(folder: Path) -> Path | None:
    """A manifest of NVIDIA's driver if the system has its library and no manifest at all."""
    if any(file for name in MANIFESTS for file in Path(name).glob("*.json")):
        return None
    ldconfig = shutil.which("ldconfig") or "/sbin/ldconfig"
    known = subprocess.run([ldconfig, "-p"], capture_output=True, text=True).stdout
    library = next((name for name in NVIDIA if name in known), None)
    if library is None:
        return None
    file = folder / "nvidia_icd.json"
    file.write_text(
        '{"file_format_version": "1.0.0", '
        f'"ICD": {{"library_path": "{library}", "api_version": "1.3.0"}}}}\n'
    )
    return file


def main() -> int:
    pack = next((Path(a) for a in sys.argv[1:] if (Path(a) / "scene").is_dir()), None)
    if pack is not None and MARK not in os.environ and (pack / "wheels").is_dir():
        try:
            environment = install(pack.resolve())
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"error: the pack cannot be installed: {error}", file=sys.stderr)
            return 2
        command = [sys.executable, "-m", "benchmarks.card", *sys.argv[1:]]
        return subprocess.run(command, env=environment).returncode
    from benchmarks.card import run

    return run.main(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
