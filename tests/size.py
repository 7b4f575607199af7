"""``python -m tests.size``: the size of the code, and a ratchet: ``--check`` fails if a figure of
``tests/size.json`` has grown, ``--update`` stores the figures of today.

Lines are all lines of Python, C++, WGSL, JavaScript, style sheets and templates that git tracks,
without the minified viewer.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
STORED = Path(__file__).with_suffix(".json")
SUFFIXES = (".py", ".cpp", ".h", ".wgsl", ".js", ".css", ".jinja")
FOLDERS = {
    "product": ("pipeline", "stages", "splatmake", "Snakefile"),
    "benchmarks": ("benchmarks",),
    "tests": ("tests",),
}
MAX_FUNCTION_LINES, MAX_PARAMETERS, MAX_FILE_LINES = 80, 8, 450


def tracked(folders: tuple[str, ...]) -> list[Path]:
    """The files of code below ``folders``."""
    command = ["git", "ls-files", "-z", "--", *folders]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [ROOT / name for name in listed.split("\0") if name]
    code = [path for path in paths if path.suffix in SUFFIXES or path.name == "Snakefile"]
    return [path for path in code if path.is_file() and not path.name.endswith(".min.js")]


def lines_of(path: Path) -> int:
    return len(path.read_bytes().splitlines())


def functions(path: Path) -> Iterator[tuple[str, int, int]]:
    """The name of each function with its numbers of lines and of parameters."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            arguments = node.args
            every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
            count = sum(argument.arg not in ("self", "cls") for argument in every)
            yield node.name, (node.end_lineno or 0) - node.lineno + 1, count


def figures() -> tuple[dict[str, int], list[str]]:
    """The figures by name, and what exceeds a limit."""
    found = {name: sum(map(lines_of, tracked(folders))) for name, folders in FOLDERS.items()}
    over: dict[str, list[str]] = {"long functions": [], "long signatures": [], "long files": []}
    for path in tracked(FOLDERS["product"]):
        place = path.relative_to(ROOT)
        if lines_of(path) > MAX_FILE_LINES:
            over["long files"].append(f"{place}: {lines_of(path)} lines")
        for name, lines, parameters in functions(path) if path.suffix == ".py" else ():
            if lines > MAX_FUNCTION_LINES:
                over["long functions"].append(f"{place}: {name} has {lines} lines")
            if parameters > MAX_PARAMETERS:
                over["long signatures"].append(f"{place}: {name} has {parameters} parameters")
    found |= {name: len(places) for name, places in over.items()}
    return found, [text for places in over.values() for text in places]


def main() -> int:
    found, places = figures()
    if "--update" in sys.argv[1:]:
        STORED.write_text(json.dumps(found, indent=2) + "\n")
    if "--check" not in sys.argv[1:]:
        print(*places, *(f"{name}: {value}" for name, value in found.items()), sep="\n")
        return 0
    stored = json.loads(STORED.read_text())
    grown = [name for name, value in found.items() if value > stored[name]]
    for name in grown:
        print(f"{name}: {found[name]}, more than {stored[name]} in tests/size.json")
    if grown:
        print("make it smaller, or run python -m tests.size --update and say why it has to grow")
    return bool(grown)


if __name__ == "__main__":
    sys.exit(main())
