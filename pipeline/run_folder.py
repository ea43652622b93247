"""Folder of a run: its configuration, and the CCDs that are finished."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..core.errors import PachonError, ProductError
from ..core.files import claim_folder
from ..core.products import Stamp
from ..core.version import VERSION
from ..reconstruction.ccd_product import MODEL_CARD, product_path, read_product, write_product
from .config import Configuration, differences, load_configuration, to_yaml
from .experiment import Experiment
from .simulate.ccd_exposure import CcdExposure
from .simulate.ccd_model import model_ccd

CONFIG_NAME, SUMMARY_NAME = "config.yaml", "summary.json"


def claim_run(folder: Path, experiment: Experiment, *, resume: bool) -> None:
    """Make the folder of a run or check that its content is of the same configuration, and write config.yaml.

    A run may be resumed with more CCDs than before, since no CCD depends on the others. A folder with another
    configuration's run, or one that cannot be made or written, raises ProductError.
    """
    path = folder / CONFIG_NAME
    heading = (
        f"pachon {VERSION}: all that decides this run.",
        "The same bytes again: pachon run config.yaml --out OTHER",
    )
    content = to_yaml(experiment.config, heading).encode()

    def check() -> None:
        try:
            before = load_configuration(path)
        except PachonError as error:
            raise ProductError(f"{folder} holds a run that cannot be read ({error}); choose another --out") from None
        _refuse_other(folder, before, experiment.config, resume)

    claim_folder(path, content, products="ccd_*.fits", check=check)


def _refuse_other(folder: Path, before: Configuration, now: Configuration, resume: bool) -> None:
    old, new = before.as_dict(), now.as_dict()
    # No CCD depends on the others, so CCDs may be added; without one of them its product would be orphaned.
    if resume and set(old["ccds"] or ()) <= set(new["ccds"]):
        del old["ccds"], new["ccds"]
    found = differences(old, new)
    if found:
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        raise ProductError(
            f"{folder} holds the run of another configuration ({'; '.join(found[:3])}{more}); choose another --out"
        )


def finished_ccds(folder: Path, experiment: Experiment, names: Iterable[str] | None = None) -> tuple[str, ...]:
    """Return the CCDs of a run, or those among some names, with complete products of this configuration."""
    stamp, names = stamp_of(experiment), (experiment.config.ccds or ()) if names is None else names
    return tuple(name for name in names if _is_whole(product_path(folder, name), stamp))


def _is_whole(path: Path, stamp: Stamp) -> bool:
    try:
        read_product(path, stamp)
    except ProductError:
        return False
    return True


def stamp_of(experiment: Experiment) -> Stamp:
    """Return the stamp of the products of an experiment."""
    return Stamp(experiment.config_hash, experiment.config.seed)


def write_ccd(experiment: Experiment, folder: Path, exposure: CcdExposure) -> None:
    """Model one CCD and write its product into the folder of a run."""
    config = experiment.config
    cards = [
        ("TELESCOP", experiment.telescope.name, "prescription"),
        ("FILTER", config.band, "band"),
        ("EXPTIME", config.atmosphere.exposure_s, "[s] exposure"),
        ("ENGINE", config.psf.engine, "PSF engine"),
        ("ATMOSPH", config.atmosphere.enabled, "whether there is an atmosphere"),
        ("WFWHM", config.reconstruction.weight_fwhm_arcsec, "[arcsec] weight of the moments"),
    ]
    if config.reconstruction.model == "focal_plane":
        cards.append((MODEL_CARD, "ccd", "model of the columns MODEL_E1 and so on"))
    write_product(folder, model_ccd(experiment, exposure), stamp_of(experiment), cards)
