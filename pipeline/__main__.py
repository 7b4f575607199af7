"""``python -m pipeline``: the command ``splatmake`` in a checkout."""

import sys

from pipeline.command.main import main

if __name__ == "__main__":
    sys.exit(main())
