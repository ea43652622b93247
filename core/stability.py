"""What of the public names is promised: sub-packages with public names, provisional names, removed names.

``docs/api_policy.md`` says what *stable* and *provisional* mean, and how long old spellings go on working.
"""

from __future__ import annotations

#: Sub-packages and modules of pachon with public names beside those of pachon itself.
PACKAGES = (
    "models",
    "raytrace",
    "wavefront",
    "design",
    "sky",
    "sensing",
    "measure",
    "reconstruction",
    "pipeline",
    "imaging",
    "studies",
    "errors",
    "testing",
)
#: Public names that may change in any minor release; all others are stable.
PROVISIONAL = frozenset(
    {
        "pachon.DonutAir",
        "pachon.DonutDetector",
        "pachon.StatisticalEngine",
        "pachon.design.Absorption",
        "pachon.design.DesignConfiguration",
        "pachon.design.GlassChoice",
        "pachon.design.WavefrontMtf",
        "pachon.design.choose_glasses",
        "pachon.imaging.CcdScene",
        "pachon.imaging.ImageCatalogue",
        "pachon.imaging.ImageSettings",
        "pachon.imaging.ObjectColours",
        "pachon.imaging.PsfField",
        "pachon.measure.CorrelatedNoise",
        "pachon.measure.LevenbergMarquardt",
        "pachon.measure.LocusSearch",
        "pachon.measure.MeanShear",
        "pachon.measure.PeakShapes",
        "pachon.measure.ShearBias",
        "pachon.measure.ShearCalibration",
        "pachon.measure.ShearEstimator",
        "pachon.measure.ShearShapes",
        "pachon.measure.detect_shear",
        "pachon.measure.mean_shear",
        "pachon.measure.shear_bias",
        "pachon.measure.shear_calibration",
        "pachon.models.CornerSensor",
        "pachon.models.GridModes",
        "pachon.models.ParabasalOptics",
        "pachon.models.corner_focal_plane",
        "pachon.models.corner_sensors",
        "pachon.models.parabasal_optics",
        "pachon.pipeline.EdgeRolloff",
        "pachon.pipeline.StarDefects",
        "pachon.pipeline.TreeRings",
        "pachon.pipeline.brighter_fatter",
        "pachon.pipeline.displace_stamps",
        "pachon.reconstruction.ColourTerm",
        "pachon.reconstruction.Instrument",
        "pachon.reconstruction.OpticsPrior",
        "pachon.reconstruction.PiffComparison",
        "pachon.reconstruction.StaticHeights",
        "pachon.reconstruction.compare_with_piff",
        "pachon.reconstruction.fit_static_heights",
        "pachon.reconstruction.psf_of_spectrum",
        "pachon.sensing.BodyMotions",
        "pachon.sensing.DonutFrames",
        "pachon.sensing.DonutRims",
        "pachon.sensing.ExposureDonuts",
        "pachon.sensing.ExposureWavefront",
        "pachon.sensing.FieldTerms",
        "pachon.sensing.FreedomEstimate",
        "pachon.sensing.ObservatoryZernikes",
        "pachon.sensing.OrientationCheck",
        "pachon.sensing.SingleDonuts",
        "pachon.sensing.TelescopeFreedoms",
        "pachon.sensing.check_orientation",
        "pachon.sensing.hexapod_corrections",
        "pachon.simulate_images",
        "pachon.sky.ListedVisit",
        "pachon.sky.VisitList",
        "pachon.sky.read_visit_list",
        "pachon.stack_visits",
        "pachon.studies.AlignConfig",
        "pachon.studies.Alignment",
        "pachon.studies.NightConfig",
        "pachon.studies.NightResult",
        "pachon.studies.PsfStack",
        "pachon.studies.Shims",
        "pachon.studies.VisitsConfig",
        "pachon.studies.align",
        "pachon.studies.load_align_configuration",
        "pachon.studies.load_night_configuration",
        "pachon.studies.load_visits_configuration",
        "pachon.studies.null_test",
        "pachon.studies.run_night",
        "pachon.studies.shim",
        "pachon.wavefront.ResidualWavefront",
        "pachon.wavefront.focus_height",
    }
)
#: What replaced names that were public in pachon once.
REMOVED: dict[str, str] = {}


def stability(name: str) -> str:
    """Return "stable" or "provisional" for a public name, such as ``"pachon.design.throughput"``."""
    return "provisional" if name in PROVISIONAL else "stable"
