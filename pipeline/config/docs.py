"""``python -m pipeline.config.docs [--check]``: the option page, the commented default YAML, and
the JSON schemas of the files that stages write.

All are made from the models, so that they can't disagree with the program.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from pipeline.config.load import Project
from pipeline.config.presets import PRESETS
from pipeline.runtime.atomic import write_text

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "configuration.md"
DEFAULTS = ROOT / "config" / "config.yaml"
SCHEMAS = ROOT / "docs" / "schemas"

# File that a stage writes -> its model. By name: no module of the library imports one above it.
_RECORDS = {
    "stage.json": "pipeline.runtime.record:StageRecord",
    "run.json": "pipeline.runtime.record:RunRecord",
    "images.json": "pipeline.scene.manifest:Manifest",
    "metrics.json": "pipeline.reporting.metrics:Metrics",
}

_INTRO = """# Configuration

Made from the schemas by `make docs`; do not edit. Every option has a default that suits most
scenes: give only what you want otherwise, in `config/config.yaml`, in a file of your own
(`--configfile mine.yaml`) or, for simple values, as `--config preset=fast`. Options under
`scenes.<name>` are for that scene alone. An unknown name or an impossible value is named before
any job starts. `auto` is settled by the plan from what the scene shows: `results/<scene>/plan.json`
says how and why.
"""


def page() -> str:
    """The Markdown of docs/configuration.md."""
    lines = [_INTRO, "## Top level", "", *_table(Project)]
    for name, info in Project.model_fields.items():
        section = _section(info)
        if section is not None:
            lines += _section_page(name, section)
    lines += ["## Presets", "", "What each sets over the defaults above.", ""]
    for preset, values in PRESETS.items():
        lines += [f"`{preset}`:", "", "```yaml"]
        lines += [yaml.safe_dump(values or {}, sort_keys=False).strip(), "```", ""]
    return "\n".join(lines).rstrip() + "\n"


def _section_page(path: str, section: type[BaseModel]) -> list[str]:
    lines = [f"## {path}", "", (section.__doc__ or "").strip(), "", *_table(section)]
    for name, info in section.model_fields.items():
        inner = _section(info)
        if inner is not None:
            lines += _section_page(f"{path}.{name}", inner)
    return lines


def _table(model: type[BaseModel]) -> list[str]:
    rows = ["| option | values | default | meaning |", "|---|---|---|---|"]
    for name, info in model.model_fields.items():
        if _section(info) is None:
            default = yaml_value(_default(info))
            meaning = (info.description or "").replace("|", "\\|")
            rows.append(f"| `{name}` | {_values(info)} | `{default}` | {meaning} |")
    return [*rows, ""] if len(rows) > 2 else []


def defaults() -> str:
    """The YAML of config/config.yaml: what is set, and everything else as comments."""
    lines = [
        "# Every option with its default; made by `make docs`. Take away the # of what you change.",
        "# docs/configuration.md says what each means.",
        "data_root: data",
        "preset: balanced",
        "",
    ]
    for name, info in Project.model_fields.items():
        if name in ("data_root", "preset"):
            continue
        lines += _commented(name, info, 0)
    return "\n".join(lines) + "\n"


def _commented(name: str, info: FieldInfo, depth: int) -> list[str]:
    pad = "  " * depth
    section = _section(info)
    if section is None:
        return [f"# {pad}{name}: {yaml_value(_default(info))}"]
    lines = [f"# {pad}{name}:"]
    for inner, inner_info in section.model_fields.items():
        lines += _commented(inner, inner_info, depth + 1)
    return lines


def _section(info: FieldInfo) -> type[BaseModel] | None:
    kind = info.annotation
    return kind if isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _default(info: FieldInfo) -> Any:
    return info.get_default(call_default_factory=True)


def yaml_value(value: Any) -> str:
    """A value as YAML on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    return yaml.safe_dump(plain, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def _values(info: FieldInfo) -> str:
    return _words(info.annotation, info.metadata)


def _words(kind: Any, metadata: Sequence[Any] = ()) -> str:
    """What a value of this type may be, for a person."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        # A Field inside a union keeps its bounds in its own metadata.
        bounds = [b for meta in kind.__metadata__ for b in getattr(meta, "metadata", [meta])]
        return _words(inner[0], bounds)
    if origin in (Union, UnionType):
        return ", ".join(_words(each) for each in inner)
    if origin is Literal:
        return ", ".join(f"`{value}`" for value in inner)
    if origin is tuple:
        return f"list of {_words(inner[0])}"
    if origin is list:
        return "list of whole numbers"
    words = {int: "whole number", float: "number", bool: "true, false", str: "text"}
    bounds = [
        f"{sign} {getattr(meta, name):g}"
        for meta in metadata
        for name, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
        if getattr(meta, name, None) is not None
    ]
    return " ".join([words.get(kind, "`null`" if kind is NoneType else "mapping"), *bounds])


def json_schemas() -> dict[Path, str]:
    """The JSON schemas (draft 2020-12) of the files that stages write, by path."""
    found = {}
    for name, model in _RECORDS.items():
        module, _, attribute = model.partition(":")
        schema = getattr(import_module(module), attribute).model_json_schema(mode="serialization")
        schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
        path = SCHEMAS / name.replace(".json", ".schema.json")
        found[path] = json.dumps(schema, indent=2) + "\n"
    return found


def main() -> int:
    """Write the files, or with ``--check`` only say whether they are current."""
    stale = []
    for path, text in {PAGE: page(), DEFAULTS: defaults(), **json_schemas()}.items():
        if not path.exists() or path.read_text() != text:
            stale.append(path.relative_to(ROOT))
            if "--check" not in sys.argv[1:]:
                write_text(path, text)
    for path in stale:
        print(f"{path}: {'not current: run make docs' if '--check' in sys.argv else 'written'}")
    return 1 if stale and "--check" in sys.argv[1:] else 0


if __name__ == "__main__":
    sys.exit(main())
