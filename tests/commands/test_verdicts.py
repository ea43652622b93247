"""Verdicts, the sentences that open reports and tables: true for few, for none, and for what cannot be measured."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from pachon.commands import verdicts
from pachon.commands.donut_report import fit_verdict
from pachon.commands.tables import Column, range_text
from pachon.pipeline.report.tables import verdict as run_verdict
from pachon.studies.alignment.product import verdict as alignment_verdict
from pachon.studies.sweep.analysis import verdict as sweep_verdict
from pachon.studies.tolerance.report import verdict as tolerance_verdict

NAN = math.nan


def run_summary(ccds=9, lost=(), **changes):
    metrics = {
        "ccds": ccds,
        "fwhm_arcsec": 0.684,
        **{"truth_psfs": 900, "truth_psfs_with_g": 899},
        **{"mean_g_truth": 0.023, "rms_residual_g_away": 0.004, "rms_scatter_g": 0.009},
        **{"mean_e_truth": 0.011, "rms_residual_away": 0.002, "rms_scatter_e": 0.0045},
        **changes,
    }
    return {"all": metrics, "not_modelled": dict.fromkeys(lost, "too few stars")}


@pytest.mark.parametrize(
    ("summary", "sentence"),
    [
        (
            run_summary(),
            'On 9 CCDs the PSF is 0.684" wide with a mean ellipticity |g| of 2.30 %; where no star is, its model errs '
            "by 0.40 % in g, against 0.90 % of a constant PSF on each CCD.",
        ),
        (
            run_summary(1, ("R22_S11",)),
            'On one CCD the PSF is 0.684" wide with a mean ellipticity |g| of 2.30 %; where no star is, its model errs '
            "by 0.40 % in g, against 0.90 % of a constant PSF; 1 CCD could not be modelled.",
        ),
        # Optics alone are narrower than a pixel: no adaptive moments, and here no width.
        (
            run_summary(mean_g_truth=NAN, fwhm_arcsec=NAN),
            "On 9 CCDs the PSF is of unknown width with a mean ellipticity |weighted e| of 1.10 %; where no star is, "
            "its model errs by 0.20 % in weighted e, against 0.45 % of a constant PSF on each CCD.",
        ),
        # The mean of the few that are wide enough is not that of the PSFs.
        (
            run_summary(truth_psfs_with_g=880, mean_g_truth=0.17),
            'On 9 CCDs the PSF is 0.684" wide with a mean ellipticity |weighted e| of 1.10 %; where no star is, its '
            "model errs by 0.20 % in weighted e, against 0.45 % of a constant PSF on each CCD. Only 880 of 900 "
            "noise-free PSFs have adaptive moments, which images narrower than 2 pixels often lack; figures of g are "
            "those of the few.",
        ),
    ],
)
def test_a_run(summary, sentence):
    assert run_verdict(summary) == sentence


def sweep_summary(changes, ranks=None, failed=0, span=(0.0, 1.0)):
    entry = {"range": span and list(span), "largest_change": changes, "rank_correlation": ranks or {}}
    return {"points": 12, "failed": failed, "metrics": {"fwhm_arcsec": entry}}


@pytest.mark.parametrize(
    ("summary", "sentence"),
    [
        (
            sweep_summary({"a": -0.25, "b": 0.1}),
            "a matters most for fwhm_arcsec, which it changes by up to -0.25 arcsec; next is b with +0.1 arcsec.",
        ),
        (
            sweep_summary({"a": 0.5}, failed=2),
            "a is the one parameter of fwhm_arcsec, which it changes by up to +0.5 arcsec. 2 of 12 points could not be "
            "computed.",
        ),
        (
            sweep_summary({}, {"a": 0.1, "b": -0.9}),
            "b matters most for fwhm_arcsec, with a rank correlation of -0.90; next is a with +0.10.",
        ),
        (sweep_summary({"a": 0.0, "b": NAN}), "No parameter changes a metric over the 12 computed points."),
        (
            sweep_summary({}, span=(0.65, 0.7)),
            "fwhm_arcsec goes from 0.65 to 0.7 arcsec over the 12 computed points, which do not tell why.",
        ),
        (sweep_summary({}, span=None), "No metric has a value at any of the 12 computed points."),
    ],
)
def test_a_sweep(summary, sentence):
    assert sweep_verdict(summary) == sentence


def tolerance_summary(draws=100, lost=0, offenders=((9.0, 9.5),), **changes):
    worst = [{"name": f"T{k}", "lower_end": low, "upper_end": high} for k, (low, high) in enumerate(offenders)]
    reached = {"reached_by_50_percent": 10.0, "reached_by_95_percent": 12.5}
    base = {"unit": "um", "draws": draws, "lost": lost, "nominal": 9.0, "worst_offenders": worst}
    return {**base, **reached, **changes}


@pytest.mark.parametrize(
    ("summary", "sentence"),
    [
        (
            tolerance_summary(),
            "Of 100 telescopes drawn, half reach 10 um and 95 % 12.5 um, where the design has 9 um; T0 costs most.",
        ),
        (
            tolerance_summary(1, requirement=11.0, **{"yield": {"fraction": 1.0}}),
            "100.0 % of the one telescope drawn meets the requirement of 11 um; T0 costs most.",
        ),
        # The lower end has no light: it costs most. Of the draws 10 are dark, so 95 % reach nothing.
        (
            tolerance_summary(lost=10, offenders=[(NAN, 9.0)], reached_by_95_percent=math.inf),
            "Of 100 telescopes drawn, half reach 10 um and 95 % no light, where the design has 9 um; 10 without "
            "light; T0 costs most.",
        ),
        (tolerance_summary(lost=100, offenders=()), "No light arrives in any of 100 telescopes drawn."),
        (
            tolerance_summary(1),
            "The one telescope drawn reaches 10 um, where the design has 9 um; T0 costs most.",
        ),
        # No tolerance changes anything.
        (
            tolerance_summary(offenders=[(9.0, 9.0)]),
            "Of 100 telescopes drawn, half reach 10 um and 95 % 12.5 um, where the design has 9 um.",
        ),
    ],
)
def test_tolerances(summary, sentence):
    assert tolerance_verdict(summary) == sentence


@pytest.mark.parametrize(
    ("first", "worst", "start"),
    [
        (None, 90.0, "Not aligned: no visit comes within {limit}; in late visits"),
        (3, 71.0, "Aligned: visit 3 is the first within {limit}, and all late visits are; in late visits"),
        (3, 73.0, "Not aligned throughout: visit 3 is the first within {limit}, but not all late visits"),
    ],
)
def test_an_alignment(first, worst, start):
    # The floor of the whole wavefront, by which visits count, is not that of what misalignment adds.
    start = start.format(limit="1.2 times the floor of 60 nm rms, the design's included")
    summary = {"first_visit_within_1.2_floors": first, "late_added_nm": 44.4, "floor_added_nm": 20.0}
    summary |= {"floor_wavefront_nm": 60.0, "late_worst_wavefront_nm": worst}
    sentence = alignment_verdict(summary)
    assert sentence.startswith(start)
    assert sentence.endswith("adds 44 nm rms, against 20 nm that no correction can remove.")


class Fit(SimpleNamespace):
    def __len__(self):
        return len(self.usable)


@pytest.mark.parametrize(
    ("usable", "convention", "sentence"),
    [
        ([True], "pachon", "The wavefront is off by 500 nm rms, most in Z5 (-400 nm)."),
        ([False], "pachon", "The donut cannot be used."),
        ([False, False], "pachon", "None of 2 donuts can be used."),
        (
            [True, False],
            "pachon",
            "1 of 2 donuts can be used: by the median the wavefront is off by 500 nm rms, most in Z5 (-400 nm).",
        ),
        ([True], "ts_wep", "The wavefront is off by 0.500 um rms, most in Z5 (-0.400 um)."),
    ],
)
def test_donuts(usable, convention, sentence):
    fit = Fit(usable=np.array(usable), noll=(4, 5))
    scale = 1e-9 if convention == "pachon" else 1e-3
    values = np.where(fit.usable[:, None], scale * np.array([300.0, -400.0]), NAN)
    assert fit_verdict(fit, SimpleNamespace(convention=convention, values=values)) == sentence


STACKS = {
    "1": {"rms_g": 0.05, "rms_residual_g_places": 0.01},
    "10": {"rms_g": 0.02, "rms_residual_g_places": 0.003},
}


@pytest.mark.parametrize(
    ("sentence", "expected"),
    [
        (
            verdicts.visits_verdict(STACKS),
            "Stacked over 10 visits the PSF has an rms ellipticity |g| of 2 %; where no star is, its model errs by 0.3 "
            "%, from 1 % over 1.",
        ),
        (
            verdicts.visits_verdict({"1": {"rms_g": NAN, "rms_residual_g_places": NAN}}),
            "In one visit the PSF has an rms ellipticity |g| of an unknown amount; where no star is, its model errs by "
            "an unknown amount.",
        ),
        (
            verdicts.null_verdict({"1": {"usable": 7, "xi_plus_difference_long": NAN, "shot_noise_xi_plus": 1e-4}}),
            "In the stack of 1 visit, 7 galaxies: no pairs are farther apart than 10', where the effect of PSF models "
            "is measured.",
        ),
        (verdicts.measure_verdict({}, 2), "No image could be measured; 2 images are left out."),
        (
            verdicts.measure_verdict({"a": {"stars": 1, "usable": 1}}, 1),
            "1 image: 1 star, and 1 galaxy usable for shear; 1 image could not be measured.",
        ),
        (
            verdicts.model_verdict({"stars": 9, "used": 8, "rms_e_held_out": 0.012, "rms_e_noise": 0.01}),
            "The PSF model is fitted to 8 of 9 stars; held out, it differs from them by 1.2 % rms in weighted e, "
            "of which 1 % is noise of the stars.",
        ),
        (
            verdicts.model_verdict({"stars": 3, "used": 3, "rms_e_held_out": NAN, "rms_e_noise": NAN}),
            "The PSF model is fitted to 3 of 3 stars, too few to hold any out: its error is unknown.",
        ),
        (
            verdicts.diagnose_verdict({"ccds": 1, "rms_e_away": 0.002, "rms_scatter_e": 0.004}, 1),
            "Over 1 CCD the PSF model errs by 0.2 % rms in weighted e where no star is, against 0.4 % of a constant "
            "PSF on each; 1 CCD is left out.",
        ),
        (
            verdicts.attribution_verdict({"full": {"rms_g_truth": 0.03}, "ccd": {"rms_g_truth": 0.02}}),
            "The PSFs have 3 % rms in g; ccd matters most, without it they have 2 %.",
        ),
        (
            verdicts.attribution_verdict({"full": {"rms_g_truth": 0.03}, "ccd": {"rms_g_truth": 0.04}}),
            "The PSFs have 3 % rms in g; none of the causes alone makes them less round.",
        ),
        (
            verdicts.attribution_verdict({"full": {"rms_g_truth": NAN}}),
            "The adaptive moments of the PSFs cannot be measured, so no cause can be named by them.",
        ),
        (
            verdicts.shim_verdict("fwhm", "rafts", SimpleNamespace(fwhm=0.7), SimpleNamespace(fwhm=0.69)),
            "Shims of rafts lower the mean FWHM: 0.7 arcsec focused as a whole, 0.69 arcsec with them.",
        ),
        (
            verdicts.shim_verdict("ellipticity", "ccds", SimpleNamespace(rms_g=0.008), SimpleNamespace(rms_g=0.004)),
            "Shims of CCDs lower the rms of g: 8e-3 focused as a whole, 4e-3 with them.",
        ),
        (
            verdicts.reproduced_verdict({"fig1": {"verdict": "agrees"}, "fig2": {"verdict": "differs"}}),
            "1 of 2 figures agree with the paper; fig2 differs.",
        ),
        (verdicts.images_verdict({}, 1), "No image is drawn: 1 image was there already."),
        (verdicts.images_verdict({"a": 1}, 2), "1 image with 1 star or galaxy; 1 image was there already."),
    ],
)
def test_tables_of_other_commands(sentence, expected):
    assert sentence == expected


def test_ranges_leave_out_what_is_no_number():
    assert range_text([1.0, NAN, 2.0], ".1f", "µm") == "1.0 to 2.0 µm"
    assert range_text([[1.0, 1.0]], ".1f") == "1.0"
    assert range_text([NAN], ".1f", "µm") == "unknown"
    column = Column("rms [µm]", "rms_um", ".2f", 1.0, "The rms radius of the spots")
    assert (
        column.verdict(None, {"rms_um": np.array([1.0, NAN])})
        == "The rms radius of the spots is 1.00 µm at 1 of 2 fields; others have none."
    )
    assert column.verdict(None, {"rms_um": np.array([NAN])}) == "The rms radius of the spots is unknown."
