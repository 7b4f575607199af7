"""From what Snakemake was given (files, --config) to validated options for each scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationError

from pipeline.config.presets import PRESETS
from pipeline.config.runs import is_config_name
from pipeline.config.schema import Config
from pipeline.runtime.errors import UserError


def _named_configs(value: Any) -> Any:
    """A list of presets is short for a mapping from their names to themselves."""
    if isinstance(value, list | tuple):
        unknown = [name for name in value if name not in PRESETS]
        if unknown:
            raise ValueError(
                f"{unknown[0]} is no preset ({', '.join(PRESETS)}); configurations of your own are "
                "a mapping from a name to its options"
            )
        return {name: {"preset": name} for name in value}
    for name in value if isinstance(value, Mapping) else ():
        if not is_config_name(str(name)):
            raise ValueError(
                f"{name!r} cannot name a configuration: letters, digits and . _ + - can, but "
                "seed0 and its like are taken"
            )
    return value


class Project(Config):
    """What a configuration file may hold: a scene's options, and these."""

    data_root: str = Field("data", description="Folder whose subfolders are scenes.")
    configs: Annotated[dict[str, dict[str, Any]], BeforeValidator(_named_configs)] = Field(
        default_factory=dict,
        description="Configurations that a batch compares: a list of presets, or a mapping from a "
        "name to options that win over the scene's, as {fast: {preset: fast}, sh0: {train: "
        "{sh_degree: 0}}}.",
    )
    seeds: list[Annotated[int, Field(ge=0, lt=2**31)]] = Field(
        default_factory=list, description="Seeds that a batch repeats every run with."
    )
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
    for config in project.configs:
        for scene in ("", *project.scenes):
            scene_config(raw, scene, config)
    return project, named


def scene_config(
    raw: Mapping[str, Any], scene: str, config: str = "", seed: int | None = None
) -> Config:
    """Options of one scene: schema <- preset <- project <- the scene's own <- the configuration's.

    Args:
        raw: the configuration as nested dicts.
        scene: its name.
        config: name of one of ``configs``; empty for none of them.
        seed: wins over all of these; or None.

    Raises:
        UserError: an unknown option or an impossible value, naming it.
    """
    own = (raw.get("scenes") or {}).get(scene) or {}
    chosen = merge({k: v for k, v in raw.items() if k in Config.model_fields}, own)
    where = f"scenes.{scene}: "
    if config:
        chosen = merge(chosen, _named_configs(raw["configs"])[config])
        where = f"configs.{config}: "
    if seed is not None:
        chosen["seed"] = seed
    preset = chosen.get("preset", Config().preset)
    return _validated(Config, merge(PRESETS.get(preset, {}), chosen), where)


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
