"""A hash of the code a stage runs, so that changed code reruns it and a comment does not."""

from __future__ import annotations

import ast
import hashlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# These decide how work is run and described, never what comes out of it; the values of the
# options themselves stand in the stage's key.
NEUTRAL = (
    "pipeline.runtime",
    "pipeline.config",
    "pipeline.plan.plan",
    "pipeline.plan.settle",
    "pipeline.plan.stage",
)

# Modules whose C++ is compiled where it runs, and its folder.
NATIVE = {
    "pipeline.render": "pipeline/render/cpu/csrc",
    "pipeline.sfm.nearest": "pipeline/sfm/csrc",
}

_COMMENT = re.compile(r'//[^\n]*|/\*.*?\*/|("(?:\\.|[^"\\])*")', re.S)


def stage_source_hash(module: str) -> str:
    """Hash of ``module`` and of all modules of the project that it imports, at any depth.

    Python counts by its syntax tree without docstrings, C++ by its text without comments and
    spacing, so that neither comments nor formatting change the hash; the pages' viewer by its
    bytes.
    """
    digest = hashlib.sha256()
    for name in sorted(_reachable(module)):
        digest.update(f"{name}={_module_hash(name)}\n".encode())
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
def _tree(module: str) -> ast.Module | None:
    file = _file_of(module)
    return None if file is None else ast.parse(file.read_text(), filename=str(file))


@cache
def _imports(module: str) -> tuple[str, ...]:
    found: list[str] = []
    tree = _tree(module)
    if tree is None:
        return ()
    for node in _runtime_nodes(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.append(node.module)
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    ours = [n for n in found if n.split(".")[0] in ("pipeline", "stages") and _file_of(n)]
    # A package's __init__ runs before its modules do.
    parents = [n.rpartition(".")[0] for n in ours if "." in n]
    return tuple(sorted({*ours, *(p for p in parents if _file_of(p))}))


def _runtime_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes but those below ``if TYPE_CHECKING:``."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        yield node
        yield from _runtime_nodes(node)


@cache
def _module_hash(module: str) -> str:
    tree = _tree(module)
    digest = hashlib.sha256()
    if tree is not None:
        digest.update(ast.dump(_without_docstrings(tree)).encode())
    if module in NATIVE:
        for file in sorted((ROOT / NATIVE[module]).glob("*")):
            if file.suffix in (".cpp", ".h"):
                text = _COMMENT.sub(lambda m: m.group(1) or " ", file.read_text())
                digest.update(f"{file.name}={' '.join(text.split())}\n".encode())
    if module == "pipeline.reporting.space":
        digest.update((ROOT / "pipeline/reporting/viewer/viewer.min.js").read_bytes())
    return digest.hexdigest()


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [n for n in node.body if not _is_string(n)] or [ast.Pass()]
    return tree


def _is_string(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
