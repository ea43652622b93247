"""Causes of ellipticity and of residuals that can be switched off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from ...core.errors import ConfigError, unknown_name
from ...models.io.site_file import load_site
from ...pipeline.config import Configuration, with_options
from ...pipeline.resolved_values import resolved_value
from ...wavefront.psf.engines import ENGINES

#: Name of the case with all causes.
FULL = "full"
#: Name of the noise of the stars as a cause, which is no option of the configuration.
NOISE = "noise"
#: Name of the optics as a cause, which are no option of the configuration.
OPTICS = "optics"
#: Altitude to which the ground layer is lifted [m]: about that of the next one over Cerro Pachon.
GROUND_LIFT = 2500.0


@dataclass(frozen=True)
class Cause:
    """Options that switch a cause off, and the reason why a configuration cannot, or None."""

    options: dict[str, Any]
    problem: Callable[[Configuration], str | None]


def _flat_heights(config: Configuration) -> str | None:
    return "focal_plane.budget = flat" if config.focal_plane.budget == "flat" else None


def _no_heights(config: Configuration) -> str | None:
    if config.focal_plane.heights is not None or config.focal_plane.moved:
        return None
    return _flat_heights(config) or (None if config.focal_plane.terms else "all terms of focal_plane are off already")


def _no_term(term: str, config: Configuration) -> str | None:
    if config.focal_plane.heights is not None:
        return f"focal_plane.heights = {config.focal_plane.heights}, which has no terms"
    return _flat_heights(config) or (None if term in config.focal_plane.terms else f"focal_plane.{term} = false")


def _no_active_optics(config: Configuration) -> str | None:
    return None if config.active_optics.states is not None else _off("active_optics.residual_um", config)


def _no_atmosphere(config: Configuration) -> str | None:
    if not config.atmosphere.enabled:
        return "atmosphere.enabled = false"
    if config.reconstruction.model == "focal_plane":
        return "reconstruction.model = focal_plane, which needs it"
    engine = config.psf.engine
    return f"psf.engine = {engine}, which needs it" if ENGINES[engine].needs_atmosphere else None


def _no_ground_layer(config: Configuration) -> str | None:
    if not (config.atmosphere.enabled and ENGINES[config.psf.engine].has_turbulence):
        return "no star is imaged through turbulence"
    if config.atmosphere.ground_lift_m > 0.0 or load_site(resolved_value(config.atmosphere.site)).altitudes[0] > 0.0:
        return "no layer is on the ground"
    return None


def _off(key: str, config: Configuration, consequence: str = "") -> str | None:
    """Return the key of a cause and its value where it is off: zero, false or null."""
    section, name = key.split(".")
    value = getattr(getattr(config, section), name)
    if value:
        return None
    return f"{key} = {'null' if value is None else 'false' if value is False else f'{value:g}'}{consequence}"


def _cause(key: str, value: float | bool | None) -> Cause:
    """Return the cause of one number or switch of the configuration, and its value without the cause."""
    return Cause({key.replace(".", "__"): value}, partial(_off, key))


#: All causes by name: terms of the CCD heights, all of them with motions of rafts and CCDs, residual aberration with
#: states of the telescope, the whole telescope, turbulence with refraction, the ground layer in common to all stars,
#: charge diffusion, the depth at which silicon absorbs light, sensor effects, and noise.
CAUSES: dict[str, Cause] = {
    **{
        term: Cause({f"focal_plane__{term}": False}, partial(_no_term, term))
        for term in ("global", "raft", "ccd", "tilt", "potato_chip")
    },
    "heights": Cause(
        {"focal_plane__heights": None, "focal_plane__budget": "flat", "focal_plane__moved": {}}, _no_heights
    ),
    "active_optics": Cause({"active_optics__residual_um": 0.0, "active_optics__states": None}, _no_active_optics),
    OPTICS: Cause({}, partial(_off, "atmosphere.enabled", consequence=", nothing would be left")),
    "atmosphere": Cause({"atmosphere__enabled": False}, _no_atmosphere),
    "ground_layer": Cause({"atmosphere__ground_lift_m": GROUND_LIFT}, _no_ground_layer),
    "diffusion": _cause("psf.diffusion_pixels", 0.0),
    "absorption_depth": _cause("detector.silicon", False),
    "brighter_fatter": _cause("sensor.brighter_fatter", None),
    "tree_rings": _cause("sensor.tree_rings_um", 0.0),
    "edge_rolloff": _cause("sensor.edge_rolloff_um", 0.0),
    NOISE: Cause({}, lambda _: None),
}


def without(config: Configuration, cause: str) -> Configuration:
    """Return the configuration with a cause switched off."""
    options = CAUSES[cause].options
    for dotted in (dotted for dotted, value in options.items() if value is None):
        name, key = dotted.split("__")
        config = config.model_copy(update={name: getattr(config, name).model_copy(update={key: None})})
    return with_options(config, **options)


def checked_causes(config: Configuration, causes: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return causes each once; by default all that can be switched off in a resolved configuration.

    A ConfigError names one that is off in the configuration already, or cannot be switched off with its engine.
    """
    if causes is None:
        return tuple(name for name, cause in CAUSES.items() if cause.problem(config) is None)
    for name in causes:
        if name not in CAUSES:
            raise unknown_name("cause", name, CAUSES)
        problem = CAUSES[name].problem(config)
        if problem is not None:
            raise ConfigError(f"{name} cannot be switched off: {problem}")
    return tuple(dict.fromkeys(causes))


def always_on(config: Configuration) -> dict[str, str]:
    """Return the causes that a resolved configuration has and cannot be without, each with the reason."""
    problem = _no_atmosphere(config) if config.atmosphere.enabled else None
    return {} if problem is None else {"atmosphere": problem}
