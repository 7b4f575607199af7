"""A hash of the code that a stage can reach, so that changes of code rerun the stage."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from pipeline.runtime.atomic import write_json
from pipeline.runtime.native import cache_folder

ROOT = Path(__file__).resolve().parents[2]

GPU = "pipeline.render.gpu"

# Modules that do not affect results; values of options are in the stage's key anyway.
NEUTRAL = (
    "pipeline.runtime",
    "pipeline.config",
    # Only stages that a GPU computes depend on it (``gpu_source_hash``).
    GPU,
    "pipeline.plan.plan",
    "pipeline.plan.settle",
    "pipeline.plan.stage",
    "pipeline.plan.values",
)

# Modules with C++ code -> the folder of its sources.
NATIVE = {
    "pipeline.render": "pipeline/render/cpu/csrc",
    "pipeline.sfm.nearest": "pipeline/sfm/csrc",
    "pipeline.mvs.patchmatch": "pipeline/mvs/csrc",
}

# The module that fills in the templates of pages.
PAGES = "pipeline.reporting.html"

# Cache: module -> digest of its file, names that it imports, hash of its syntax tree. Parsing all
# modules takes longer than the rest of Snakemake's start.
RECORD = "sources.json"
_unsaved: set[str] = set()

_COMMENT = re.compile(r'//[^\n]*|/\*.*?\*/|("(?:\\.|[^"\\])*")', re.S)


def stage_source_hash(module: str) -> str:
    """Hash of ``module`` and of all modules of the project that it imports, directly or not.

    Python files are hashed by their syntax trees without docstrings, C++ files by their text
    without comments and whitespace, so that comments and formatting do not change the hash; the
    templates and the viewer of pages by their bytes. Hashes of modules are cached beside the
    compiled libraries.
    """
    digest = hashlib.sha256()
    for name in sorted(_reachable(module)):
        digest.update(f"{name}={_module_hash(name)}\n".encode())
    _save_cache()
    return digest.hexdigest()[:16]


@cache
def gpu_source_hash() -> str:
    """Hash of the GPU backend's modules and kernels."""
    folder = ROOT.joinpath(*GPU.split("."))
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*.py")):
        digest.update(f"{file.name}={_parsed(f'{GPU}.{file.stem}')[1]}\n".encode())
    for file in sorted(folder.glob("wgsl/*.wgsl")):
        text = _COMMENT.sub(lambda m: m.group(1) or " ", file.read_text("utf-8"))
        digest.update(f"{file.name}={' '.join(text.split())}\n".encode())
    _save_cache()
    return digest.hexdigest()[:16]


def _reachable(module: str) -> set[str]:
    seen: set[str] = set()
    queue = [module]
    while queue:
        name = queue.pop()
        if name in seen or name.startswith(NEUTRAL):
            continue
        seen.add(name)
        queue += _imports(name)
    return seen


def _file_of(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


@cache
def _imports(module: str) -> tuple[str, ...]:
    ours = [n for n in _parsed(module)[0] if n.split(".")[0] in ("pipeline", "stages")]
    ours = [n for n in ours if _file_of(n)]
    # Importing a module also imports the __init__ of its package.
    parents = [n.rpartition(".")[0] for n in ours if "." in n]
    return tuple(sorted({*ours, *(p for p in parents if _file_of(p))}))


@cache
def _module_hash(module: str) -> str:
    digest = hashlib.sha256(_parsed(module)[1].encode())
    if module in NATIVE:
        for file in sorted((ROOT / NATIVE[module]).glob("*")):
            if file.suffix in (".cpp", ".h"):
                text = _COMMENT.sub(lambda m: m.group(1) or " ", file.read_text())
                digest.update(f"{file.name}={' '.join(text.split())}\n".encode())
    if module == PAGES:
        folder = ROOT.joinpath(*module.split(".")).parent
        for file in sorted([*folder.rglob("templates/**/*.*"), folder / "viewer/viewer.min.js"]):
            digest.update(file.read_bytes())
    return digest.hexdigest()


# --- parsing ----------------------------------------------------------------------------------


@cache
def _parsed(module: str) -> tuple[list[str], str]:
    """The names that a module imports, and the hash of its syntax tree."""
    file = _file_of(module)
    if file is None:
        return [], ""
    text = file.read_bytes()
    digest = hashlib.sha256(text).hexdigest()
    known = _record().get(module)
    if known is None or known[0] != digest:
        tree = ast.parse(text, filename=str(file))
        code = ast.dump(_without_docstrings(tree))
        known = [digest, _imported(tree), hashlib.sha256(code.encode()).hexdigest()]
        _record()[module] = known
        _unsaved.add(module)
    return known[1], known[2]


def _imported(tree: ast.Module) -> list[str]:
    found: list[str] = []
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.append(node.module)
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in _statements(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [n for n in node.body if not _is_string(n)] or [ast.Pass()]
    return tree


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """A node and all statements inside it, at any depth, except those under TYPE_CHECKING."""
    yield node
    only_types = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    for name in ("body", "handlers", "orelse", "finalbody", "cases"):
        inside = () if name == "body" and only_types else getattr(node, name, ())
        for statement in inside if isinstance(inside, list) else ():
            yield from _statements(statement)


def _is_string(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@cache
def _record() -> dict[str, list[Any]]:
    """The cache of earlier processes with the same parser; ``_parsed`` adds to it."""
    try:
        stored = json.loads((cache_folder() / RECORD).read_text())
        return dict(stored["modules"]) if stored["parser"] == _parser() else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _save_cache() -> None:
    if _unsaved:
        with contextlib.suppress(OSError):  # The cache is optional.
            write_json(cache_folder() / RECORD, {"parser": _parser(), "modules": _record()})
        _unsaved.clear()


def _parser() -> str:
    """Python's version and the hash of this file, on which hashes of syntax trees depend."""
    own = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
    return f"{sys.version_info[:3]} {own}"
