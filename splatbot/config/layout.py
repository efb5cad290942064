"""Layout of configuration files: public keys under their section, all others under ``expert:``, old names."""

from __future__ import annotations

import warnings
from typing import Any

from splatbot.config.sections import (
    BundleConfig,
    Config,
    LoopsConfig,
    MappingConfig,
    SensorConfig,
    TrackingConfig,
    _Section,
)
from splatbot.errors import ConfigError, DeprecatedNameWarning

SECTIONS: dict[str, type[_Section]] = {
    "sensor": SensorConfig,
    "tracking": TrackingConfig,
    "mapping": MappingConfig,
    "loops": LoopsConfig,
    "bundle": BundleConfig,
}
EXPERT = "expert"

_NAMED = 12  # old keys that a warning names, at most

# Names of earlier versions, as section.key, with the present ones.
_RENAMED = {
    **{f"tracking.{key}": f"sensor.{key}" for key in SensorConfig.model_fields},
    "tracking.gate": "sensor.max_depth_difference",
    "tracking.depth_doubt": "sensor.depth_sigma_scale",
    "tracking.wide": "tracking.gicp",
    "tracking.wide_points": "tracking.gicp_points",
    "tracking.match_enough": "tracking.min_local_matches",
    "tracking.min_valid": "tracking.min_depth_coverage",
    "mapping.new_opacity": "mapping.initial_opacity",
    "mapping.new_alpha": "mapping.unexplained_alpha",
    "mapping.new_depth": "mapping.surface_depth_tolerance",
    "mapping.solid_alpha": "mapping.reference_alpha",
    "mapping.rate_means": "mapping.means_lr",
    "mapping.rate_quats": "mapping.quats_lr",
    "mapping.rate_scales": "mapping.scales_lr",
    "mapping.rate_opacities": "mapping.opacities_lr",
    "mapping.rate_sh": "mapping.sh_lr",
    "mapping.normal_share": "mapping.normal_step_scale",
    "mapping.look_every": "mapping.observe_interval_s",
    "mapping.settle": "mapping.dynamic_timeout_s",
    "mapping.still": "mapping.still_joint_speed",
    "loops.min_shift": "loops.min_translation",
    "loops.min_turn": "loops.min_rotation",
    "loops.max_strain": "loops.max_edge_sigma",
}


def path_of(section: str, key: str) -> str:
    """Return the dotted name of a setting in files and flags, as ``expert.tracking.n_pixels``."""
    if section in SECTIONS and key in SECTIONS[section].model_fields and key not in SECTIONS[section].PUBLIC:
        return f"{EXPERT}.{section}.{key}"
    return f"{section}.{key}"


def to_layout(values: dict[str, Any]) -> dict[str, Any]:
    """Return a dumped :class:`Config` in the layout of files."""
    public: dict[str, Any] = {}
    expert: dict[str, Any] = {}
    for name, value in values.items():
        if name not in SECTIONS:
            public[name] = value
            continue
        keys = SECTIONS[name].PUBLIC
        public[name] = {key: item for key, item in value.items() if key in keys}
        expert[name] = {key: item for key, item in value.items() if key not in keys}
    given = {name: value for name, value in public.items() if value != {}}
    return given | {EXPERT: {name: keys for name, keys in expert.items() if keys}}


def from_layout(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a file in the layout of :class:`Config`, and warn about old names.

    A name of an earlier version, and an expert key outside ``expert:``, still hold. Unknown keys are left in place;
    the validation of :class:`Config` reports them.

    Raises:
        ConfigError: ``expert:`` or a section in it is no mapping, or holds a public key, or a key is set twice.
    """
    flat: dict[str, Any] = {}
    old: list[str] = []
    for section, keys in values.items():
        if section == EXPERT:
            continue
        if section in SECTIONS and isinstance(keys, dict):
            for key, value in keys.items():
                if key == "sensor":
                    raise ConfigError(
                        "is a section of its own.", field=f"{section}.{key}", hint="write `sensor: {...}`"
                    )
                _assign(flat, section, key, value, f"{section}.{key}", old)
        elif section in SECTIONS and keys is None:
            continue
        else:
            flat[section] = keys
    for section, keys in _mapping(values.get(EXPERT), EXPERT).items():
        for key, value in _mapping(keys, f"{EXPERT}.{section}").items():
            if section not in SECTIONS or key in SECTIONS[section].PUBLIC:
                hint = f"write {section}.{key}" if section in SECTIONS else f"sections: {', '.join(SECTIONS)}"
                raise ConfigError("is no expert key.", field=f"{EXPERT}.{section}.{key}", hint=hint)
            _assign(flat, section, key, value, f"{EXPERT}.{section}.{key}", old)
    if old:
        rest = f"; and {len(old) - _NAMED} more" if len(old) > _NAMED else ""
        hint = "`splatbot map --config FILE --dump-config` prints a file with the present keys"
        names = "; ".join(old[:_NAMED])
        warnings.warn(f"old configuration keys: {names}{rest}. {hint}", DeprecatedNameWarning, stacklevel=3)
    return flat


def _assign(flat: dict[str, Any], section: str, key: str, value: Any, given: str, old: list[str]) -> None:
    section, _, key = _RENAMED.get(f"{section}.{key}", f"{section}.{key}").partition(".")
    present = path_of(section, key)
    if present != given:
        old.append(f"{given} is now {present}")
    keys = flat.setdefault(section, {})
    if key in keys:
        raise ConfigError("is set twice.", field=present, hint=f"remove {given}")
    keys[key] = value


def _mapping(value: Any, field: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ConfigError("is not a mapping.", field=field, hint="write `expert: {section: {key: value}}`")
    return value


def known_sections() -> set[str]:
    """Return the top-level keys that a configuration file may hold."""
    return {*Config.model_fields, EXPERT}
