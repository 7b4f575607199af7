"""``python -m pipeline doctor``: what it finds, and its exit code."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import doctor
from pipeline.command.main import main
from pipeline.render import devices
from pipeline.render.devices import Adapter, DeviceChoice
from pipeline.runtime import processor
from pipeline.runtime.isolate import ProcessDied
from tests.tools import need_package

REPOSITORY = Path(__file__).parents[1]


def program(folder: Path, name: str, output: str) -> None:
    """A program that prints ``output``."""
    folder.mkdir(exist_ok=True)
    file = folder / name
    file.write_text(f"#!/bin/sh\ncat <<'END'\n{output}\nEND\n")
    file.chmod(0o755)


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with a C++ compiler alone: the folder on its PATH."""
    folder = tmp_path / "bin"
    program(folder, "g++", "g++ 99.1\nall rights reserved")
    (folder / "cat").symlink_to("/bin/cat")
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setenv("SPLATMAKE_CACHE", str(tmp_path / "cache"))
    for name in ("CXX", "SPLATMAKE_TARGET", "VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr(doctor, "VULKAN_FOLDERS", (str(tmp_path / "icd.d"),))
    return folder


def topics(results: Path) -> dict[str, doctor.Finding]:
    return {finding.topic: finding for finding in doctor.examine(results)}


def test_a_machine_that_can_run_is_ready(bare, tmp_path, capsys):
    assert main(["doctor", "--results", str(tmp_path / "results")]) == 0
    shown = capsys.readouterr().out
    assert "g++ 99.1" in shown and "not built" in shown and shown.endswith("ready to run\n")
    for topic in ("processor", "cores", "instruction set", "memory", "GPU", "Vulkan", "disk"):
        assert f" {topic} " in shown
    assert topics(tmp_path)["GPU"].state == topics(tmp_path)["Vulkan"].state == "absent"


def test_no_compiler_and_no_library_is_an_error_with_a_remedy(bare, tmp_path, capsys):
    (bare / "g++").unlink()
    assert main(["doctor", "--json"]) == 2
    shown = json.loads(capsys.readouterr().out)
    missing = [f for f in shown["findings"] if f["state"] == "missing"]
    assert not shown["ready"]
    assert [finding["topic"] for finding in missing] == ["rasterizer", "matcher", "stereo"]
    assert all("install g++" in finding["fix"] for finding in missing)


def test_a_missing_package_is_an_error_and_an_optional_one_is_not(bare, tmp_path, monkeypatch):
    versions = doctor._version
    absent = {"pillow-heif", "viser"}
    monkeypatch.setattr(doctor, "_version", lambda name: None if name in absent else versions(name))
    found = topics(tmp_path)
    assert found["viser"].state == "absent" and found["viser"].fix == "pip install viser"
    assert doctor.is_ready(list(found.values()))
    absent.add("torch")
    found = topics(tmp_path)
    assert found["torch"].state == "missing"
    assert not doctor.is_ready(list(found.values()))


def test_an_old_python_is_an_error(bare, monkeypatch):
    monkeypatch.setattr(doctor, "PYTHON", (4, 0))
    (found,) = doctor._python()
    assert found.state == "missing" and found.fix == "install Python 4.0 or newer"


def test_a_target_that_the_processor_lacks_is_an_error(bare, tmp_path, monkeypatch):
    monkeypatch.setattr(processor, "architecture", lambda: "x86-64")
    monkeypatch.setattr(processor, "features", lambda: processor.BASELINE["x86-64"])
    assert "x86-64-v2 is used" in topics(tmp_path)["instruction set"].text
    monkeypatch.setenv("SPLATMAKE_TARGET", "x86-64-v4")
    found = topics(tmp_path)["instruction set"]
    assert found.state == "missing" and "avx512f" in found.text


def test_the_compiler_that_cxx_names_is_the_one_used(bare, tmp_path, monkeypatch):
    program(bare, "clang++", "clang version 88")
    found = topics(tmp_path)
    assert (found["compiler g++"].state, found["compiler clang++"].state) == ("used", "there")
    monkeypatch.setenv("CXX", "clang++")
    found = topics(tmp_path)
    assert found["compiler clang++ ($CXX)"].state == "used"
    assert found["compiler g++"].state == "there"


def test_graphics_devices_are_shown_as_not_used(bare, tmp_path):
    program(bare, "nvidia-smi", "NVIDIA X1, 16376 MiB, 550.1\nNVIDIA X2, 8188 MiB, 550.1")
    (tmp_path / "icd.d").mkdir()
    (tmp_path / "icd.d" / "radeon_icd.json").write_text("{}")
    gpus = [finding.text for finding in doctor._graphics() if finding.topic == "GPU"]
    assert [text.partition(",")[0] for text in gpus] == ["NVIDIA X1", "NVIDIA X2"]
    assert "radeon_icd" in topics(tmp_path)["Vulkan"].text
    found = doctor._graphics()
    assert {finding.state for finding in found if finding.topic != "training"} == {"there"}


@pytest.mark.skipif(sys.platform != "linux", reason="not run: libvulkan1 is Linux's")
def test_the_packages_that_wgpu_lacks_are_named(bare, tmp_path, monkeypatch):
    """On a server with wgpu alone: the loader and the driver's manifest, each with its package."""
    monkeypatch.setattr(doctor, "find_spec", lambda name: object())
    monkeypatch.setattr(doctor, "_training_devices", lambda has_graphics: [])
    monkeypatch.setattr(doctor, "VULKAN_LOADER", "libvulkan-hidden.so.1")
    found = {finding.topic: finding for finding in doctor._graphics()}
    assert "libvulkan1" in str(found["Vulkan loader"].fix)
    assert "mesa-vulkan-drivers" in str(found["Vulkan"].fix)
    monkeypatch.setattr(doctor, "VULKAN_LOADER", "libc.so.6")
    monkeypatch.setattr(doctor, "_output", lambda command: "NVIDIA X1, 8 GB, 1")
    found = {finding.topic: finding for finding in doctor._graphics()}
    assert "Vulkan loader" not in found
    assert "NVIDIA_DRIVER_CAPABILITIES" in str(found["Vulkan"].fix)


def test_the_device_that_trains_is_shown_with_the_reason(bare, tmp_path, monkeypatch):
    """A GPU if it is faster in the stored measurement; never one in software."""
    need_package("wgpu")
    card = Adapter(1, "Radeon 1", "driver 2", "discrete", "Vulkan")
    software = Adapter(0, "llvmpipe", "Mesa", "software", "Vulkan")
    found = [software]
    monkeypatch.setattr(devices, "adapters", lambda: found)
    times: list[object] = [(0.010, 0.025)]

    def timed(*_: object) -> object:
        if isinstance(times[0], Exception):
            raise times[0]
        return times[0]

    monkeypatch.setattr(devices, "run_isolated", timed)

    def shown() -> dict[str, doctor.Finding]:
        return {finding.topic: finding for finding in doctor._graphics()}

    assert "llvmpipe, is software" in shown()["training"].text
    assert devices.choose_device().reason == ""
    found.insert(0, card)
    assert shown()["gpu:1"].state == "used" and shown()["gpu:0"].state == "there"
    assert "10 ms on Radeon 1 (discrete, Vulkan), 25 on the proc" in shown()["training"].text
    # Stored for this driver.
    times[0] = (0.025, 0.010)
    assert devices.choose_device().device == "gpu:1"
    found[0] = replace(card, driver="driver 3")
    assert shown()["gpu:1"].state == "there"
    assert devices.choose_device().reason.startswith("trained on the processor, where a step")
    times[0] = ProcessDied("died by signal SIGSEGV")
    found[0] = replace(card, driver="driver 4")
    assert "fails: died by signal SIGSEGV" in shown()["training"].text
    times[0] = (0.010, 0.025)
    assert devices.choose_device().device == "cpu", "not tried again with this driver"
    (tmp_path / "cache" / devices.RECORD).write_text("{")
    assert devices.choose_device().device == "gpu:1"

    def read_only(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(devices, "write_json", read_only)
    found[0] = replace(card, driver="driver 5")
    assert devices.choose_device().device == "gpu:1", "the record is optional"
    found.clear()
    assert "none was found" in shown()["training"].text
    monkeypatch.setattr(devices, "find_spec", lambda _: None)
    assert devices.choose_device() == DeviceChoice(
        "cpu", "", "on the processor; wgpu is not installed"
    )


def test_little_disk_and_memory_are_said(bare, tmp_path, monkeypatch):
    assert topics(tmp_path / "not" / "there")["disk"].text.endswith(f"(in {tmp_path})")
    monkeypatch.setattr(doctor, "LOW_DISK", 1 << 62)
    monkeypatch.setattr(doctor, "LOW_MEMORY", 1 << 62)
    found = topics(tmp_path)
    assert found["disk"].fix and found["memory"].fix
    assert doctor.is_ready(list(found.values()))


def test_it_needs_none_of_the_packages(tmp_path):
    """The report must come where they are missing."""
    code = (
        "import sys\n"
        "for name in ('torch', 'numpy', 'pydantic', 'scipy'): sys.modules[name] = None\n"
        "from pipeline.command.main import main\n"
        "sys.exit(main(['doctor']))\n"
    )
    run = [sys.executable, "-c", code]
    environment = os.environ | {"SPLATMAKE_CACHE": str(tmp_path)}
    done = subprocess.run(run, capture_output=True, text=True, cwd=REPOSITORY, env=environment)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "cannot be loaded" in done.stdout or "not installed" in done.stdout
