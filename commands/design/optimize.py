"""Commands with exact derivatives: ``sensitivity`` and ``optimize``."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from typer import Option

from ...core.errors import ConfigError, PrescriptionError, PrescriptionWarning
from ...core.file_names import file_name
from ...core.number_text import counted
from .. import completion
from ..choices import choice, names
from ..inputs import errors_of, warnings_shown
from ..options import name_list, set_option, yaml_file
from ..tables import Column
from .command import Outcome, SharedOptions, design_command

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ...design.optimize.merit_function import MeritName
    from ...design.optimize.operand import Operand
    from ...models.parameters.degrees_of_freedom import DegreesOfFreedom
    from ...models.parameters.parameters import Parameter
    from ...models.telescope import Telescope

_ADDRESSES = "Separated by commas: M2.dx, Camera.* (six motions), M1.radius, M1.conic, M1.a6, M1.Z4-22, L1_entrance.n"

#: Addresses for messages.
_EXAMPLE = "M2.dx,M1.radius"


def _largest_terms(result: Any) -> list[str]:
    """Return the three Noll terms of each parameter that change most over the fields; a dash where none does."""
    size = (result.matrix[:, 3:] ** 2).mean(axis=0) ** 0.5
    largest = size.argsort(axis=0)[::-1][:3]
    return [
        ", ".join(f"Z{row + 4}" for row in rows if of_parameter[row] > 0) or "-"
        for rows, of_parameter in zip(largest.T, size.T, strict=True)
    ]


def _sensitivity_verdict(summary: dict[str, Any]) -> str:
    """Return the parameter of each unit that changes the wavefront most, for a small step of it."""
    from ...core.units import ARCSEC

    # Small steps, by the unit of the parameter: their size and name.
    steps = {"m": (1e-6, "µm"), "rad": (ARCSEC, "arcsec"), "um": (1.0, "µm"), "1": (1.0, "unit")}
    strongest: dict[str, tuple[float, str]] = {}
    for name, unit, rms in zip(
        summary["parameters"], summary["units"], summary["wavefront_rms_m_per_unit"], strict=True
    ):
        strongest[unit] = max(strongest.get(unit, (-1.0, "")), (float(rms), name))
    changes = []
    for unit, (rms, name) in strongest.items():
        size, step = steps.get(unit, (1.0, unit))
        changes.append(f"{name}, by {1e9 * rms * size:.4g} nm rms per {step}")
    return f"The wavefront changes most with {', and '.join(changes)}."


@design_command(
    Column("parameter", lambda result: result.parameters.names),
    Column("largest Noll terms", _largest_terms),
    Column("rms wavefront", lambda result: result.rms, ".5g"),
    Column("unit", lambda result: ["m" if unit == "1" else f"m/{unit}" for unit in result.parameters.units]),
    caption="Rms over the fields, piston and tilt left out.",
    left=2,
    verdict=_sensitivity_verdict,
)
def sensitivity(
    shared: SharedOptions,
    parameters: Annotated[
        str | None,
        names(
            completion.addresses,
            listed=True,
            metavar="ADDRESS,...",
            help=f"{_ADDRESSES}. By default five motions of every mirror and group but the first mirror.",
        ),
    ] = None,
    degrees_of_freedom: Annotated[
        str | None,
        names(
            completion.degrees_of_freedom,
            metavar="lsst|FILE",
            help="In place of parameters: named degrees of freedom, or a .yaml of them.",
        ),
    ] = None,
    zernikes: Annotated[int, Option(min=4, max=500, help="Highest Noll index.")] = 28,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Matrix to write, .fits or .ecsv; named after the model.")
    ] = None,
) -> Outcome:
    """Compute and save the sensitivity matrix: derivatives of Zernike terms, field by field, to degrees of freedom.

    Exact, in metres of wavefront per metre, radian or unit. Without fields: 31 of them, the axis and two rings.

    **Examples**

    - `pachon sensitivity lsst_v3.3_r`
    - `pachon sensitivity lsst_v3.3_r --parameters "M2.*,Camera.*,M1.Z4-22" --out matrix.ecsv`
    - `pachon sensitivity lsst_v3.3_r --degrees-of-freedom lsst`
    - `pachon sensitivity paul_baker --parameters M2.dz,M3.radius --field-deg 0 --field-deg 0.5 --json`
    """
    from ...design.optimize.sensitivity import sensitivity as compute
    from ...design.optimize.sensitivity_file import write_sensitivity
    from ...models.parameters.degrees_of_freedom_file import load_degrees_of_freedom
    from ...models.parameters.parameters import usual_parameters
    from ...models.paraxial import following_stop

    if out is not None and out.suffix not in (".fits", ".ecsv"):
        raise ConfigError(f"--out {out}: expected a name that ends in .fits or .ecsv")
    if parameters is not None and degrees_of_freedom is not None:
        raise ConfigError("--parameters and --degrees-of-freedom are both given: expected one of them")
    telescope, *where = shared.first_arguments
    variables: DegreesOfFreedom | Iterable[str | Parameter]
    if degrees_of_freedom is not None:
        variables = load_degrees_of_freedom(degrees_of_freedom)
    else:
        variables = (
            usual_parameters(telescope) if parameters is None else name_list(parameters, "--parameters", _EXAMPLE)
        )
    result = compute(telescope, variables, *where, n_zernike=zernikes, **shared.trace_options)
    path = out or Path(f"sensitivity_{shared.stem}.fits")
    write_sensitivity(path, result)
    values, _ = result.modes()
    notes = [f"singular values: {values[0]:.3g} to {values[-1]:.3g}", f"matrix: {path.resolve()}"]
    if following_stop(telescope) is not telescope:
        notes.insert(0, f"rays fill the stop {telescope.design_data.stop}, as with --aiming real")
    return Outcome(result, notes=notes)


#: Relative difference between focal length and scale on the detector from which on it is said.
_SAME_SCALE = 1e-3
#: Units in which operands are shown that are small beside the lens, as in files.
_SMALL = {"rms_spot": ("µm", 1e-6), "rms_wavefront": ("nm", 1e-9), "sag": ("µm", 1e-6)}


def _shown_unit(result: Any, unit: str) -> tuple[str, float]:
    """Return the unit in which tables show numbers of an SI unit, and its size: lengths in that of the lens."""
    return _optimum(result).telescope.length_unit if unit == "m" else (unit, 1.0)


def _operand_unit(result: Any, operand: Operand) -> tuple[str, float]:
    if operand.stated is None and operand.unit == "m":
        return _SMALL.get(operand.kind, _shown_unit(result, "m"))
    unit, size = operand.shown_unit
    return unit or "1", size


def _of_variables(name: str) -> Callable[[Any], list[float]]:
    """Return the function from a result to an attribute of its optimum, variable by variable, in the units shown."""

    def values(result: Any) -> list[float]:
        optimum = _optimum(result)
        sizes = [_shown_unit(optimum, parameter.unit)[1] for parameter in optimum.variables]
        return [float(v) / size for v, size in zip(getattr(optimum, name), sizes, strict=True)]

    return values


@design_command(
    Column("variable", "variables"),
    Column("unit", lambda result: [_shown_unit(result, p.unit or "1")[0] for p in _optimum(result).variables]),
    Column("start", _of_variables("start_values"), ".9g"),
    Column("end", _of_variables("values"), ".9g"),
    Column("change", _of_variables("changes"), ".4g"),
    Column("uncertainty", _of_variables("uncertainty"), ".2g"),
    Column(
        lambda s: f"effect of the change [µ{'rad' if 'rms_start_rad' in s else 'm'}]",
        lambda result: _optimum(result).step_effects,
        ".4g",
        1e6,
    ),
    left=2,
    band=True,
)
def optimize(
    shared: SharedOptions,
    variables: Annotated[
        str | None,
        names(
            completion.addresses,
            listed=True,
            metavar="ADDRESS,...",
            help=f"{_ADDRESSES}, L1.thickness, silica.abbe.",
        ),
    ] = None,
    merit: Annotated[
        str | None, choice(("spots", "wavefront"), help="Merit function to minimise, spots by default.")
    ] = None,
    focal_length: Annotated[float | None, Option(help="Paraxial focal length to be held [m].")] = None,
    bounds: Annotated[
        list[str] | None,
        names(
            completion.addresses,
            metavar="ADDRESS=LOW:HIGH",
            help="Limits of a variable, of a motion those of its change: in SI, or as S1.radius_mm=40:60.",
        ),
    ] = None,
    config: Annotated[
        Path | None, yaml_file("FILE.yaml", "In place of these: variables, operands, configurations, glasses.")
    ] = None,
    settings: Annotated[list[str] | None, set_option("optimization")] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Prescription to write; by default named after the model.")
    ] = None,
) -> Outcome:
    """Optimise a telescope over chosen variables, compensators among them, with exact derivatives.

    A file has operands (focal length, distortion, edges, angles...), several configurations, bounds with units, glasses
    to choose from the catalogue and random restarts; see docs/howto/optimisation.md.

    **Examples**

    - `pachon optimize lsst_v3.3_r --variables Camera.dz,M2.dz`
    - `pachon optimize paul_baker --variables M1.conic,M2.conic --merit wavefront --bounds M1.conic=-1.1:-0.9`
    - `pachon optimize triplet.zmx --config opt.yaml --set restarts=4 --out better.yaml`
    """
    from ...design.optimize.targets import FocalLength
    from ...models.digits import with_optimised_digits
    from ...models.io.prescription import save_telescope

    if (config is None) == (variables is None):
        raise ConfigError("pachon optimize: expected either --variables or --config")
    if config is not None:
        for name, value in (("merit", merit), ("focal-length", focal_length), ("bounds", bounds)):
            if value is not None:
                raise ConfigError(f"--{name} is given beside --config: expected it in the file")
        result = _from_file(shared, config, out, settings or ())
    elif settings:
        raise ConfigError("--set is given without --config: expected the file whose keys it sets")
    else:
        from ...design.optimize.configuration import DesignConfiguration
        from ...design.optimize.optimize import optimize as compute

        _check_out(shared, out)
        result = compute(
            DesignConfiguration(*shared.first_arguments, projection=shared.projection),
            name_list(variables or "", "--variables", _EXAMPLE),
            cast("MeritName", merit or "spots"),
            bounds=dict(_bounds(shared.telescope, text) for text in bounds or ()),
            targets=() if focal_length is None else (FocalLength(focal_length),),
            threads=shared.threads,
        )
    optimum = _optimum(result)
    paths = [out or Path(f"{_optimized_name(file_name(telescope.name))}.yaml") for telescope in optimum.telescopes]
    with warnings_shown(PrescriptionWarning):
        for solved, path in zip(optimum.telescopes, paths, strict=True):
            # Analyses of the optimised lens have names of their own, beside those of its source.
            telescope = replace(with_optimised_digits(solved), name=path.stem)
            try:
                save_telescope(telescope, path, lenient=shared.lenient)
            except PrescriptionError as error:
                # What took long is not lost.
                yaml_path = path.with_suffix(".yaml")
                save_telescope(telescope, yaml_path)
                raise error.within(subject=f"{path}, in place of which {yaml_path.name} was written") from None
    verdict, *notes = _notes(result)
    return Outcome(result, notes=[*notes, *(f"prescription: {path.resolve()}" for path in paths)], verdict=verdict)


def _optimized_name(stem: str) -> str:
    """Return the name of an optimised telescope: optimized_lens, then optimized_2_lens of that, and so on."""
    optimized = re.fullmatch(r"optimized_(?:(\d+)_)?(.+)", stem)
    return f"optimized_{int(optimized[1] or 1) + 1}_{optimized[2]}" if optimized else f"optimized_{stem}"


def _check_out(shared: SharedOptions, out: Path | None, *, several: bool = False) -> None:
    """Raise before a computation what cannot be written after it."""
    from ...models.io.prescription import prescription_files

    if out is None:
        return
    if several:
        raise ConfigError(f"--out {out}: expected none with several configurations, each is named after its telescope")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PrescriptionWarning)
        prescription_files(shared.telescope, out, lenient=shared.lenient)


def _from_file(shared: SharedOptions, path: Path, out: Path | None, settings: Sequence[str]) -> Any:
    """Return the optimum of a file, or the choice of glasses that it asks for."""
    from ...design.optimize.glass_choice import choose_glasses
    from ...design.optimize.optimize import optimize as compute
    from ...design.optimize.optimize_file import catalogue_of, load_optimization, optimization_arguments

    if shared.fields is not None or shared.wavelength is not None:
        raise ConfigError("--field-deg or --wavelength-nm is given beside --config: expected them in the file")
    file = load_optimization(path, settings)
    _check_out(shared, out, several=bool(file.configurations))
    arguments = optimization_arguments(file, shared.telescope, path, shared.projection)
    if file.glasses and file.configurations:
        raise ConfigError("glasses: expected a file without configurations", file=path)
    catalogue = catalogue_of(file, path)
    with errors_of(path):
        if not file.glasses:
            return compute(**arguments, threads=shared.threads)
        choice: Any = dict(glasses=file.glasses, nearest=file.nearest_glasses, catalogue=catalogue)
        return choose_glasses(**arguments, **choice, threads=shared.threads)


def _optimum(result: Any) -> Any:
    """Return the optimum of a result, which may be a choice of glasses."""
    return getattr(result, "optimum", result)


def _notes(result: Any) -> list[str]:
    """Return merit and operands before and after, glasses and collinear combinations as lines."""
    s, optimum = result.summary(), _optimum(result)
    unit, (start, end) = "µrad" if optimum.in_angles else "µm", 1e6 * optimum.merits
    lines = [f"rms of {s['merit']}: {start:.6g} -> {end:.6g} {unit}, {counted(s['steps'], 'step')}"]
    stated = 1e6 * optimum.remeasured[:, 1]
    if stops := ", ".join(optimum.filled_stops):
        lines.append(f"rays fill the stop {stops}, as with --aiming real; without: {_from_to(stated)} {unit}")
    if not optimum.is_better:
        lines.append(f"not better than the start: {s['merit']} of {_from_to((start, end))} {unit}")
    if s["operands"]:
        start, end = 1e6 * optimum.history[[0, -1]]
        lines.append(f"with operands: {start:.6g} -> {end:.6g} {unit}")
    several = len(s["configurations"]) > 1
    for evaluation in optimum.operands:
        name, size = _operand_unit(optimum, evaluation.operand)
        unit = "" if name == "1" else f" {name}"
        owner = f" of {evaluation.configuration}" if several else ""
        label, goal = evaluation.operand.label, evaluation.operand.goal_text(size)
        off = "" if evaluation.holds else f": not held, off by {evaluation.deviation / size:.3g}{unit}"
        lines.append(
            f"{label}{owner}: {evaluation.start / size:.6g} -> {evaluation.end / size:.6g}{unit} ({goal}){off}"
        )
    lines += _focal_length_notes(optimum)
    lines += _glass_notes(result)
    return lines + [f"collinear: {combination}" for combination in s["collinear"]]


def _glass_notes(result: Any) -> list[str]:
    """Return the chosen glasses, each with all that were tried and the rms that they reach, the best first."""
    lines = []
    unit = "µrad" if _optimum(result).in_angles else "µm"
    for start_glass, end_glass in getattr(result, "glasses", {}).items():
        trials = sorted((t for t in result.trials if t.glass == start_glass), key=lambda trial: trial.rms)
        texts = [f"{t.name} {1e6 * t.rms:.4g}" if math.isfinite(t.rms) else f"{t.name} without light" for t in trials]
        lines += [f"glass: {start_glass} -> {end_glass}", f"  tried, rms with operands in {unit}: {', '.join(texts)}"]
    return lines


def _focal_length_notes(optimum: Any) -> list[str]:
    """Return a line where `focal_length` or `f_number` was another number in earlier files, of a defocused detector."""
    from ...core.errors import PachonError
    from ...design.optimize.targets import FNumber, FocalLength, ImageScale

    kinds = [c.operand.kind for c in optimum.operands if isinstance(c.operand, FocalLength | FNumber)]
    stated_kinds = [c.operand.kind for c in optimum.operands if c.operand.kind in kinds and c.operand.stated is None]
    if not stated_kinds:
        return []
    name, size = optimum.telescope.length_unit
    try:
        scale, focal_length = (cls(0.0).measure(optimum.telescope) for cls in (ImageScale, FocalLength))
    except PachonError:
        return []
    if abs(scale - abs(focal_length)) <= _SAME_SCALE * scale:
        return []
    return [
        f"{stated_kinds[0]}: that of the paraxial focal length, {focal_length / size:.6g} {name}; the scale on the "
        f"detector, its meaning in earlier files, is image_scale, {scale / size:.6g} {name}"
    ]


def _from_to(pair: Any) -> str:
    return f"{pair[0]:.6g} -> {pair[1]:.6g}"


def _bounds(telescope: Telescope, text: str) -> tuple[str, tuple[float, float]]:
    """Return address and limits of a bound: in SI, or in the unit at the end of the address, as in files."""
    from ...models.parameters.changes import ANGLES, LENGTHS, parse_change

    name, _, limits = text.partition("=")
    try:
        low, high = (float(limit) for limit in limits.split(":"))
    except ValueError:
        raise ConfigError(f"--bounds {text}: expected ADDRESS=LOW:HIGH, such as M1.conic=-1.1:-0.9") from None
    address, size = name.strip(), 1.0
    if address.rpartition("_")[2] in (*LENGTHS, *ANGLES):
        parameter, size = parse_change(telescope, address, "--bounds")
        address = parameter.address
    return address, (size * low, size * high)
