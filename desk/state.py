"""The state of a desk: every number that a slider sets, its history, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..core.errors import ConfigError, DomainError, unknown_name
from ..models.camera.height_budget import TERMS

#: Version of the files of states.
VERSION = 1
#: Most states that can be undone.
_MOST_STEPS = 200
#: Sizes of the hidden misalignment of M2 by its motion, at most [um, arcsec]: blurs of up to 2 arcsec.
_HIDDEN = {"M2_dz": 40.0, "M2_dx": 800.0, "M2_dy": 800.0, "M2_rx": 30.0, "M2_ry": 30.0}


@dataclass(frozen=True)
class DeskState:
    """All numbers of a desk.

    Parameters
    ----------
    model : str
        Bundled telescope, or path of a file.
    optics : mapping of str to float
        Values of degrees of freedom by name, in their units; zero for those left out.
    hidden : mapping of str to float
        The same of a misalignment that is to be found: added, and not shown.
    heights : mapping of str to float
        Peak to valley of the terms of the height budget [um; urad for tilt]; zero for those left out.
    lifts : mapping of str to float
        Lifts of CCDs and rafts by name [um].
    seed : int
        Seed of the heights.
    wavelength_nm : float
        Vacuum wavelength [nm].
    field_deg : tuple of float
        Field angles of the star that wavefront, PSF and encircled energy are of [deg].
    seeing_arcsec : float
        FWHM of the atmosphere at 500 nm by its Fried parameter, 0.9759 wavelengths over r0 [arcsec]; 0 without one.
    """

    model: str
    optics: Mapping[str, float] = field(default_factory=dict)
    hidden: Mapping[str, float] = field(default_factory=dict)
    heights: Mapping[str, float] = field(default_factory=dict)
    lifts: Mapping[str, float] = field(default_factory=dict)
    seed: int = 1
    wavelength_nm: float = 600.0
    field_deg: tuple[float, float] = (0.0, 0.0)
    seeing_arcsec: float = 0.6

    def __post_init__(self) -> None:
        for name in ("optics", "hidden", "heights", "lifts"):
            values = {key: _finite(value, f"{name}.{key}") for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, {key: value for key, value in values.items() if value})
        for term, size in self.heights.items():
            if term not in TERMS:
                raise unknown_name("height term", term, TERMS)
            if size < 0:
                raise DomainError(f"heights.{term} = {size!r}: expected a peak to valley of zero or more")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise DomainError(f"seed = {self.seed!r}: expected a whole number of zero or more")
        wavelength = _finite(self.wavelength_nm, "wavelength_nm")
        seeing = _finite(self.seeing_arcsec, "seeing_arcsec")
        if not wavelength > 0:
            raise DomainError(f"wavelength_nm = {wavelength!r}: expected a positive length")
        if not 0 <= seeing <= 10:
            raise DomainError(f"seeing_arcsec = {seeing!r}: expected a number from 0 to 10")
        if isinstance(self.field_deg, str) or np.shape(self.field_deg) != (2,):
            raise DomainError(f"field_deg = {self.field_deg!r}: expected two angles")
        x, y = (_finite(value, "field_deg") for value in self.field_deg)
        for name, value in {"wavelength_nm": wavelength, "seeing_arcsec": seeing, "field_deg": (x, y)}.items():
            object.__setattr__(self, name, value)

    def value(self, control: str) -> float:
        """Return the number of a control, ``optics.M2_dz`` or ``seeing_arcsec``."""
        section, _, name = control.partition(".")
        if section == "field_deg":
            return self.field_deg["xy".index(name)]
        return float(getattr(self, section).get(name, 0.0) if name else getattr(self, section))

    def with_value(self, control: str, value: float) -> DeskState:
        """Return the state with another number of a control."""
        section, _, name = control.partition(".")
        if section == "field_deg":
            x, y = self.field_deg
            return replace(self, field_deg=(value, y) if name == "x" else (x, value))
        whole = int(value) if section == "seed" else value
        changes: dict[str, Any] = {section: {**getattr(self, section), name: value} if name else whole}
        return replace(self, **changes)

    @property
    def total_optics(self) -> dict[str, float]:
        """Values of the degrees of freedom, those of the hidden misalignment added."""
        names = dict.fromkeys((*self.optics, *self.hidden))
        return {name: self.optics.get(name, 0.0) + self.hidden.get(name, 0.0) for name in names}

    def misaligned(self, seed: int) -> DeskState:
        """Return the state with a hidden misalignment of M2, drawn from a seed."""
        draw = np.random.default_rng(seed).uniform(0.4, 1.0, len(_HIDDEN))
        sign = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], len(_HIDDEN))
        # Shift and tilt across the same axis undo one another in part: half of them are drawn.
        axis = seed % 2
        moved = ("M2_dz", "M2_dx", "M2_rx") if axis else ("M2_dz", "M2_dy", "M2_ry")
        sizes = zip(_HIDDEN.items(), draw * sign, strict=True)
        return replace(self, hidden={name: round(float(f * size), 1) for (name, size), f in sizes if name in moved})

    def to_yaml(self) -> str:
        """Return the state as the text of a file."""
        content = {"desk": VERSION} | {f.name: _plain(getattr(self, f.name)) for f in fields(self)}
        return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))

    @classmethod
    def from_yaml(cls, text: str, source: str = "state") -> DeskState:
        """Read a state; text of another version or with wrong keys is a ConfigError of one line."""
        from ..core.yaml_reader import read_value

        try:
            content = read_value(text)
        except ValueError as error:
            raise ConfigError(f"expected YAML, as the desk saves it: {error}", file=source) from None
        if not isinstance(content, dict) or "desk" not in content:
            raise ConfigError("desk: expected the state of a desk, which begins with its version", file=source)
        if content.pop("desk") != VERSION:
            raise ConfigError(f"desk: expected version {VERSION}, which this program reads", file=source, key="desk")
        names = [f.name for f in fields(cls)]
        for key in content:
            if key not in names:
                raise ConfigError(str(unknown_name("key", str(key), names)), file=source)
        if not isinstance(content.get("model"), str):
            raise ConfigError("model: expected the name of a telescope", file=source, key="model")
        for key in ("optics", "hidden", "heights", "lifts"):
            if not isinstance(content.get(key, {}), dict):
                raise ConfigError(f"{key} = {content[key]!r}: expected numbers by name", file=source, key=key)
        try:
            return cls(**content)
        except (DomainError, KeyError) as error:
            raise ConfigError(str(error), file=source) from None

    @classmethod
    def from_file(cls, path: Path) -> DeskState:
        """Read a state from a file."""
        from ..core.files import read_bytes

        return cls.from_yaml(read_bytes(path, ConfigError, max_bytes=10**6).decode("utf-8", "replace"), str(path))


def is_state_file(path: Path) -> bool:
    """Return whether a file begins like the state of a desk."""
    try:
        with path.open("rb") as file:
            return file.read(5) == b"desk:"
    except OSError:
        return False


def _finite(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise DomainError(f"{name} = {value!r}: expected a finite number")
    return float(value)


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else list(value) if isinstance(value, tuple) else value


class History:
    """The states of a desk, to be undone and redone, and the one that others are compared to."""

    def __init__(self, state: DeskState) -> None:
        self._states, self._index, self._control = [state], 0, ""
        self.start = self.reference = state

    @property
    def state(self) -> DeskState:
        """The state now."""
        return self._states[self._index]

    def push(self, state: DeskState, control: str = "") -> None:
        """Add a state. One that follows by the same control replaces the one before: a drag is one step."""
        if state == self.state:
            return
        del self._states[self._index + 1 :]
        if control and control == self._control and self._index:
            self._states[self._index] = state
        else:
            self._states = [*self._states, state][-_MOST_STEPS:]
        self._index, self._control = len(self._states) - 1, control

    def undo(self) -> DeskState:
        """Go back by one step, where there is one."""
        return self._go(-1)

    def redo(self) -> DeskState:
        """Go on by one step, where one was undone."""
        return self._go(1)

    def refuse(self, last_good: DeskState) -> None:
        """Take out the state now, which cannot be drawn, and go to the last one that was.

        A drag may have put it in place of that one. It leaves nothing to redo.
        """
        before, after = self._states[: self._index], self._states[self._index + 1 :]
        if before and before[-1] == last_good:
            self._index -= 1
        elif not (after and after[0] == last_good):
            before = [*before, last_good]
        self._states, self._control = before + after, ""

    def settle(self) -> None:
        """End a drag: the next change is a step of its own."""
        self._control = ""

    def _go(self, steps: int) -> DeskState:
        self._control = ""
        self._index = min(max(self._index + steps, 0), len(self._states) - 1)
        return self.state
