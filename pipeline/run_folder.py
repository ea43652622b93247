"""Folder of a run: its configuration, and the CCDs that are finished."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..core.errors import PachonError
from ..core.files import write_json
from ..core.long_work import claim_folder
from ..core.products import Card, Stamp, is_whole
from ..core.version import VERSION
from ..reconstruction.ccd_product import MODEL_CARD, CcdProduct, product_path, write_product
from .config import load_configuration, to_yaml
from .experiment import Experiment
from .listed_visit import visit_cards
from .simulate.ccd_exposure import CcdExposure
from .simulate.ccd_loop import one_by_one
from .simulate.ccd_model import model_ccds

CONFIG_NAME, SUMMARY_NAME = "config.yaml", "summary.json"


def claim_run(folder: Path, experiment: Experiment, *, resume: bool) -> None:
    """Make the folder of a run or check that its content is of the same configuration, and write config.yaml.

    A run may be resumed with more CCDs than before, since no CCD depends on the others. A folder with another
    configuration's run, or one that cannot be made or written, raises ProductError.
    """
    path, settings = folder / CONFIG_NAME, experiment.config.as_dict()
    heading = (
        f"pachon {VERSION}: all that decides this run.",
        "The same bytes again: pachon run config.yaml --out OTHER",
    )

    def read(path: Path) -> dict[str, Any]:
        before = load_configuration(path).as_dict()
        # No CCD depends on the others, so CCDs may be added; without one of them its product would be orphaned.
        if resume and set(before["ccds"] or ()) <= set(settings["ccds"]):
            before["ccds"] = settings["ccds"]
        return before

    content = to_yaml(experiment.config, heading).encode()
    claim_folder(path, content, products="ccd_*.fits", noun="a run", now=settings, read=read)


def finished_ccds(folder: Path, experiment: Experiment, names: Iterable[str] | None = None) -> tuple[str, ...]:
    """Return the CCDs of a run, or those among some names, with complete products of this configuration."""
    stamp, names = stamp_of(experiment), (experiment.config.ccds or ()) if names is None else names
    return tuple(name for name in names if is_whole(product_path(folder, name), stamp))


def write_reasons(folder: Path, experiment: Experiment, names: Iterable[str], failed: Mapping[str, str]) -> None:
    """Write why CCDs of a part of a run cannot be modelled, for the other parts; `names` are all CCDs of the part."""
    for name in names:
        if name in failed:
            write_json(_reason_path(folder, name), {**stamp_of(experiment).meta(), "not_modelled": failed[name]})
        else:
            _reason_path(folder, name).unlink(missing_ok=True)


def read_reasons(folder: Path, experiment: Experiment, names: Iterable[str]) -> dict[str, str]:
    """Return why CCDs cannot be modelled, as far as other parts of this configuration have written it."""
    reasons = {}
    for name in names:
        with suppress(OSError, ValueError, TypeError, KeyError):
            content = json.loads(_reason_path(folder, name).read_text())
            reason = str(content.pop("not_modelled"))
            if content == stamp_of(experiment).meta():
                reasons[name] = reason
    return reasons


def _reason_path(folder: Path, ccd: str) -> Path:
    return folder / f"not_modelled_{ccd}.json"


def stamp_of(experiment: Experiment) -> Stamp:
    """Return the stamp of the products of an experiment."""
    return Stamp(experiment.config_hash, experiment.config.seed)


def write_ccds(experiment: Experiment, folder: Path, exposures: Sequence[CcdExposure]) -> list[PachonError | None]:
    """Model CCDs and write their products into the folder of a run; return the errors of those that have none.

    Nothing is written after a product that cannot be.
    """
    stamp = stamp_of(experiment)

    def write(exposure: CcdExposure, product: CcdProduct | PachonError) -> None:
        if isinstance(product, PachonError):
            raise product
        write_product(folder, product, stamp, ccd_cards(experiment, exposure.name))

    return one_by_one(write, exposures, model_ccds(experiment, exposures))


def ccd_cards(experiment: Experiment, ccd: str) -> list[Card]:
    """Return the cards of the header of a CCD's product that describe the run."""
    config = experiment.config
    cards: list[Card] = [
        ("TELESCOP", experiment.telescope.name, "prescription"),
        ("FILTER", config.band, "band"),
        ("EXPTIME", config.atmosphere.exposure_s, "[s] exposure"),
        ("ENGINE", config.psf.engine, "PSF engine"),
        ("ATMOSPH", config.atmosphere.enabled, "whether there is an atmosphere"),
        ("WFWHM", config.reconstruction.weight_fwhm_arcsec, "[arcsec] weight of the moments"),
    ]
    if config.reconstruction.model == "focal_plane":
        cards.append((MODEL_CARD, "ccd", "model of the columns MODEL_E1 and so on"))
    return cards + visit_cards(experiment, ccd)
