"""Run Snakemake with this process's arguments, without its line about the profile.

``splatmake`` starts this file by its path: the program's packages need not be importable.
"""

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import snakemake.cli

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


def main() -> None:
    """Run ``snakemake.cli.main``."""
    parse = snakemake.cli.parse_args

    def parse_quietly(argv: Any) -> Any:
        said = io.StringIO()
        try:
            with contextlib.redirect_stderr(said):
                return parse(argv)
        finally:
            lines = said.getvalue().splitlines(keepends=True)
            sys.stderr.writelines(line for line in lines if not line.startswith("Using "))

    snakemake.cli.parse_args = parse_quietly
    snakemake.cli.main()


if __name__ == "__main__":
    main()
