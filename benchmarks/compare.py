"""``python -m benchmarks.compare``: earlier name of ``splatmake compare``."""

import sys

from pipeline.command.main import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
