"""The files that a package holds beside its modules: the workflow's, and the kernels on request.

pyproject.toml says the rest. With SPLATMAKE_PREBUILT=1 the native libraries of all x86-64 levels
(or of this architecture) are compiled into the wheel, against the torch of the environment that
builds it: build without isolation.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

PREBUILT = os.environ.get("SPLATMAKE_PREBUILT") == "1"
WORKFLOW = ("Snakefile", "profiles")


class BuildPackages(build_py):
    """Adds ``pipeline/workflow`` and, on request, ``pipeline/prebuilt``."""

    def run(self):
        if self.editable_mode:
            return super().run()
        build = Path(self.build_lib)
        # Modules and libraries of an earlier build that no longer exist would be packed.
        shutil.rmtree(build, ignore_errors=True)
        super().run()
        target = build / "pipeline" / "workflow"
        for name in WORKFLOW:
            copy = shutil.copytree if Path(name).is_dir() else shutil.copy2
            self.mkpath(str(target))
            copy(name, target / name)
        if PREBUILT:
            command = [sys.executable, "-m", "pipeline.command.kernels"]
            subprocess.run([*command, str(build / "pipeline" / "prebuilt")], check=True)


class Wheel(bdist_wheel):
    """With kernels: for one platform, and any Python 3, for they use nothing of Python's."""

    def get_tag(self):
        python, abi, platform = super().get_tag()
        return ("py3", "none", platform) if PREBUILT else (python, abi, platform)


class WithKernels(Distribution):
    def has_ext_modules(self):
        return PREBUILT


setup(
    distclass=WithKernels,
    cmdclass={"build_py": BuildPackages, "bdist_wheel": Wheel},
)
