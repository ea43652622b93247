"""Names and units of the columns of visit lists, by quantity."""

from __future__ import annotations

from typing import NamedTuple


class ListedQuantity(NamedTuple):
    """Quantity of a visit, as lists have it."""

    text: str  #: in messages
    unit: str  #: of columns without a unit; empty for pure numbers and texts
    names: tuple[str, ...]  #: of columns, in small letters; the first that a list has is taken


#: Quantities by key. Names are those of rubin_scheduler and OpSim, new and old, of ConsDB's visit1 and
#: visit1_quicklook, of the headers of instance catalogues, of LSST's visit table, and our own.
QUANTITIES = {
    "visit": ListedQuantity(
        "number of the visit", "", ("observationid", "visitid", "visit_id", "visit", "exposure_id", "obshistid")
    ),
    "ra": ListedQuantity("right ascension", "deg", ("fieldra", "ra", "s_ra", "rightascension")),
    "dec": ListedQuantity("declination", "deg", ("fielddec", "dec", "s_dec", "declination")),
    "midpoint": ListedQuantity("middle of the exposure", "d", ("exp_midpt_mjd", "expmidptmjd", "mjd")),
    "start": ListedQuantity("start of the visit", "d", ("observationstartmjd", "obs_start_mjd", "expmjd")),
    "exposure": ListedQuantity("exposure time", "s", ("visitexposuretime", "exp_time", "exptime", "visitexptime")),
    "visit_time": ListedQuantity("time of an instance catalogue", "s", ("vistime",)),
    "snaps": ListedQuantity("number of snaps", "", ("numexposures", "nsnap", "snaps")),
    "band": ListedQuantity("band", "", ("band", "filter", "physical_filter", "physicalfilter")),
    "rotator": ListedQuantity("angle of the rotator", "deg", ("rottelpos", "physical_rotator_angle", "rotator_deg")),
    "sky_rotation": ListedQuantity("angle of the camera on the sky", "deg", ("rotskypos", "sky_rotation")),
    "roll": ListedQuantity("position angle of the telescope", "deg", ("roll_deg", "position_angle_deg")),
    "altitude": ListedQuantity("altitude", "deg", ("altitude",)),
    "zenith_distance": ListedQuantity("zenith distance", "deg", ("zenith_distance", "zenithdistance")),
    "airmass": ListedQuantity("airmass", "", ("airmass",)),
    "azimuth": ListedQuantity("azimuth", "deg", ("azimuth",)),
    "r0": ListedQuantity("Fried parameter", "m", ("r0_m", "r0", "fried_parameter")),
    "seeing": ListedQuantity("seeing at 500 nm", "arcsec", ("seeingfwhm500", "rawseeing", "seeing")),
    "monitor": ListedQuantity("seeing of a monitor", "arcsec", ("dimm_seeing",)),
    "psf_seeing": ListedQuantity("rms width at the zenith and 500 nm", "pixel", ("seeing_zenith_500nm_median",)),
    "outer_scale": ListedQuantity("outer scale", "m", ("outer_scale_m", "outer_scale", "l0")),
    "wind_speed": ListedQuantity("speed of the wind on the ground", "m/s", ("wind_speed", "windspeed")),
    "wind_azimuth": ListedQuantity("azimuth that the wind blows from", "deg", ("wind_dir", "wind_direction")),
    "sky": ListedQuantity("sky", "mag", ("skybrightness", "sky_brightness", "filtskybrightness", "sky_mag")),
    "epoch": ListedQuantity("epoch", "", ("epoch",)),
    "weight": ListedQuantity("weight", "", ("weight", "inverse_variance")),
    "night": ListedQuantity("night", "", ("night",)),
}
#: Words that the header of an instance catalogue may begin with.
HEADER_WORDS = frozenset(
    ("rightascension", "declination", "mjd", "altitude", "azimuth", "filter", "rotskypos", "rottelpos", "dist2moon",
     "moonalt", "moondec", "moonphase", "moonra", "nsnap", "obshistid", "seed", "seeing", "sunalt", "vistime", "seqnum",
     "minsource", "exptime", "camconfig")
)  # fmt: skip
