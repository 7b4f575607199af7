"""``python -m benchmarks.compare``: ``splatmake compare`` by its earlier name."""

import sys

from pipeline.command.main import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
