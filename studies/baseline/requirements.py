"""Tolerances and limits of metrics as texts, such as ``spot rms = 0.1 um`` and ``spot rms < 10 um``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from astropy import units as u

from ...core.arguments import check_arguments
from ...core.errors import ConfigError
from .file import Limit

_RULE = re.compile(r"\s*([^<>=]*?)\s*([<>=])\s*([^<>=]+?)\s*")
_AMOUNT = re.compile(r"([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(.*)")
_EXPECTED = {
    "tolerance": "a part of the values, such as '1 %', or NAME = AMOUNT, such as 'spot rms = 0.1 um' or 'ee80 = 2 %'",
    "limit": "NAME < AMOUNT or NAME > AMOUNT, such as 'spot rms < 10 um'",
}


@dataclass(frozen=True)
class Rule:
    """Tolerance or limit of all metrics whose names begin with some words."""

    option: str  #: ``tolerance`` or ``limit``
    text: str
    start: str  #: first words of the names; empty for all metrics
    sign: str  #: ``=`` of a tolerance, ``<`` or ``>`` of a limit
    number: float
    unit: str  #: as given; empty for that of each metric

    def applies_to(self, name: str) -> bool:
        """Return whether a metric has these first words."""
        return not self.start or name == self.start or name.startswith(f"{self.start} ")

    def amount(self, name: str, unit: str) -> float:
        """Return the number in the unit of a metric; ConfigError if it does not convert."""
        if not self.unit:
            return self.number
        try:
            converted = (self.number * u.Unit(self.unit)).to_value(u.Unit(unit))
        except (ValueError, u.UnitConversionError):
            raise self._error(f"expected a unit that converts to {unit or 'a pure number'}, that of {name}") from None
        return float(f"{converted:.12g}")  # 1e-3 mm are 1.0000000000000002 um

    def unused(self, names: Iterable[str], left_out: Mapping[str, str]) -> ConfigError:
        """Return the error of a rule that no metric follows, with the reason where its kind could not be computed."""
        kind = self.start.partition(" ")[0]
        if kind in left_out:
            return self._error(f"no metrics of kind {kind}: {left_out[kind]}")
        kinds = ", ".join(sorted({name.partition(" ")[0] for name in names}))
        return self._error(f"no metric begins with {self.start!r}; there are {kinds}")

    def _error(self, problem: str) -> ConfigError:
        return ConfigError(f"{self.option} = {self.text!r}: {problem}")


@check_arguments
@dataclass(frozen=True)
class Requirements:
    """Tolerances and limits of the metrics of a baseline, each a text.

    Attributes
    ----------
    tolerances : tuple of str
        Tolerances in place of those of rounding: ``1 %`` of the values of all metrics, ``spot rms = 0.1 um`` of those
        whose names begin with these words.
    limits : tuple of str
        Requirements: ``spot rms < 10 um``, ``vignetting > 0.5``.

    Raises
    ------
    ConfigError
        If a text is none of these.
    """

    tolerances: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _ = self.tolerance_rules, self.limit_rules

    @property
    def tolerance_rules(self) -> tuple[Rule, ...]:
        """Rules of the tolerances, those with the most words last."""
        return parse_rules("tolerance", self.tolerances)

    @property
    def limit_rules(self) -> tuple[Rule, ...]:
        """Rules of the limits, those with the most words last."""
        return parse_rules("limit", self.limits)


def parse_rules(option: str, texts: Sequence[str]) -> tuple[Rule, ...]:
    """Return the rules of texts of an option, ``tolerance`` or ``limit``, those with the most words last."""
    rules = []
    for text in texts:
        matched = _RULE.fullmatch(text)
        start, sign, amount = matched.groups() if matched else ("", "=", text.strip())
        parts = _AMOUNT.fullmatch(amount)
        try:
            number = float(parts[1]) if parts else math.nan
        except ValueError:
            number = math.nan
        usable = math.isfinite(number) and (bool(start) if sign != "=" else number > 0.0)
        if parts is None or not usable or (sign == "=") != (option == "tolerance") or (not start and parts[2] != "%"):
            raise ConfigError(f"{option} = {text!r}: expected {_EXPECTED[option]}")
        rules.append(Rule(option, text, start, sign, number, parts[2]))
    return tuple(sorted(rules, key=lambda rule: len(rule.start)))


def given_tolerance(rules: Sequence[Rule], name: str, unit: str, value: float, least: float) -> float | None:
    """Return the tolerance of the last rule that applies to a metric; None without one.

    A percentage is a part of the value, but never less than `least`, the metric's own tolerance, below which rounding
    moves it.
    """
    for rule in reversed(rules):
        if rule.applies_to(name):
            return max(least, abs(value) * rule.number / 100.0) if rule.unit == "%" else rule.amount(name, unit)
    return None


def given_limit(rules: Sequence[Rule], name: str, unit: str) -> Limit | None:
    """Return the limit of a metric by the last rules that apply to it; None without any."""
    bounds = {"min" if rule.sign == ">" else "max": rule.amount(name, unit) for rule in rules if rule.applies_to(name)}
    if not bounds:
        return None
    if bounds.get("min", -math.inf) >= bounds.get("max", math.inf):
        raise ConfigError(f"limit of {name}: expected a least value below the largest, {bounds['max']:g} {unit}")
    return Limit(**bounds)


def check_used(rules: Sequence[Rule], names: Iterable[str], left_out: Mapping[str, str]) -> None:
    """Raise ConfigError for a rule that applies to none of the names; reasons by kind of metrics not computed."""
    names = tuple(names)
    for rule in rules:
        if not any(rule.applies_to(name) for name in names):
            raise rule.unused(names, left_out)
