"""config.json of runs that were trained with other fields: in today's layout."""

from collections.abc import Mapping
from typing import Any

from spacesim.data.files import JsonDict, JsonMapping

ALIASES = {"park": "baseline-park"}  #: words that methods had: today's
_STRATEGIES = ("mesh-aware", "support-aware", "mcmc")
_GONE = ("flatten_weight",)  #: fields that only training read


def in_this_layout(values: JsonMapping) -> JsonDict:
    """The fields of a TrainConfig, plain values; those in today's layout stay as they are, but for what runs had that
    name no `beta_min`, and so does what is neither: the reader then says what is wrong."""
    values = {name: value for name, value in values.items() if name not in _GONE}
    if isinstance(method := values.get("method"), str):
        values["method"] = ALIASES.get(method, method)
    strategies = {name: values.pop(name.replace("-", "_"), {}) for name in _STRATEGIES}
    if isinstance(kind := values.get("strategy"), str) and isinstance(table := strategies.get(kind, {}), Mapping):
        values["strategy"] = {"kind": kind, **table}
    if isinstance(light := values.get("light"), Mapping):
        values["light"] = _light(dict(light))
    return values


def not_trained_any_more(values: dict[str, Any]) -> str:
    """What the training of a run with this config.json, which can be read, did that it does no longer, so that it
    cannot go on; "" where nothing."""
    light = values.get("light") or {}
    shadow = light.get("shadow") or {}
    method = shadow.get("method")
    if light.get("radiance") and "encoded" not in light:
        return "compares radiance by the mu-law"
    if shadow.get("gradients") or (isinstance(method, dict) and method.get("gradients")):
        return "moves Gaussians through their shadows"
    return ""


def _light(light: JsonDict) -> JsonDict:
    field, shadow = light.get("field"), light.get("shadow")
    if light.get("linear") is True:
        light = {"encoded": False, **light}
    if isinstance(field, Mapping) and isinstance(field.get("surface"), bool):
        field = dict(field)
        kind = "surface" if field.pop("surface") else "directions"
        field["inputs"] = {"kind": kind, **{name: field.pop(name) for name in ("sun", "view") if name in field}}
        light["field"] = field
    if isinstance(shadow, Mapping) and isinstance(method := shadow.get("method"), str):
        shadow = dict(shadow)
        mapping, gradients = shadow.pop("mapping", {}), shadow.pop("gradients", False)
        settings = mapping if method == "mapping" and isinstance(mapping, Mapping) else {"gradients": gradients}
        light["shadow"] = shadow = {**shadow, "method": {"kind": method, **settings}}
    if isinstance(shadow, Mapping) and isinstance(method := shadow.get("method"), Mapping):
        ends = {"beta_min": 0.05} if method.get("kind") == "splatting" else {}
        if method.get("sun_radius_deg") == 0:  # of windows as wide as a penumbra, which are gone
            method = {name: value for name, value in method.items() if name not in ("sun_radius_deg", "widest")}
        if ends and isinstance(method.get("gradients"), bool):  # through shadows, which only training read
            method = {name: value for name, value in method.items() if name != "gradients"}
        light["shadow"] = {**shadow, "method": {**ends, **method}}
    return light
