"""From what Snakemake was given (files, --config) to validated options for each scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, ValidationError

from pipeline.config.presets import PRESETS
from pipeline.config.schema import Config
from pipeline.runtime.errors import UserError


class Project(Config):
    """What a configuration file may hold: a scene's options, and these."""

    data_root: str = Field("data", description="Folder whose subfolders are scenes.")
    scenes: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="Options for single scenes, by the scene's name."
    )


def load_project(raw: Mapping[str, Any]) -> tuple[Project, dict[str, Config]]:
    """Validate a configuration.

    Args:
        raw: the configuration as nested dicts.

    Returns:
        The project, and the options of each scene named in ``scenes``.

    Raises:
        UserError: an unknown option or an impossible value, naming it.
    """
    project = _validated(Project, raw, "")
    named = {name: scene_config(raw, name) for name in project.scenes}
    return project, named


def scene_config(raw: Mapping[str, Any], scene: str) -> Config:
    """Options of one scene: schema <- preset <- project <- the scene's own.

    Raises:
        UserError: an unknown option or an impossible value, naming it.
    """
    common = {k: v for k, v in raw.items() if k not in ("data_root", "scenes")}
    own = (raw.get("scenes") or {}).get(scene) or {}
    chosen = merge(common, own)
    preset = chosen.get("preset", Config().preset)
    return _validated(Config, merge(PRESETS.get(preset, {}), chosen), f"scenes.{scene}: ")


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the values of ``over`` in their places, dicts merged at every depth."""
    merged = dict(base)
    for name, value in over.items():
        old = merged.get(name)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[name] = merge(old, value) if both else value  # type: ignore[arg-type]
    return merged


def _validated(model: type[Any], raw: Mapping[str, Any], prefix: str) -> Any:
    try:
        return model.model_validate(dict(raw))
    except ValidationError as error:
        lines = []
        for problem in error.errors():
            where = ".".join(str(part) for part in problem["loc"])
            if problem["type"] == "extra_forbidden":
                lines.append(f"{prefix}{where}: no such option{_nearest(model, problem['loc'])}")
            else:
                lines.append(f"{prefix}{where}: {problem['msg']}, found {problem['input']!r}")
        raise UserError(
            "the configuration is not valid:\n  " + "\n  ".join(dict.fromkeys(lines)),
            fix="see docs/configuration.md for every option",
        ) from None


def _nearest(model: type[Any], loc: tuple[Any, ...]) -> str:
    """A hint at the option that was probably meant."""
    from difflib import get_close_matches

    fields = model.model_fields
    for part in loc[:-1]:
        inner: Any = fields[part].annotation if part in fields else None
        if not hasattr(inner, "model_fields"):
            return ""
        fields = inner.model_fields
    close = get_close_matches(str(loc[-1]), list(fields), n=1)
    return f" (did you mean {close[0]}?)" if close else ""
