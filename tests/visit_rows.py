"""Visits made up for the mapping from lists to optics, with the columns of rubin_scheduler."""

COLUMNS = (
    *("observationId", "fieldRA", "fieldDec", "observationStartMJD", "visitExposureTime", "numExposures", "band"),
    *("rotTelPos", "seeingFwhm500", "skyBrightness", "night"),
)
ROWS = (
    (1001, 53.10, -27.80, 61001.150000, 30.0, 1, "r", -35.0, 0.72, 21.10, 1),
    (1002, 53.42, -27.55, 61001.150451, 30.0, 1, "r", -35.0, 0.70, 21.12, 1),
    (1003, 52.88, -28.10, 61012.204000, 30.0, 1, "i", 42.5, 0.95, 20.30, 12),
    (1004, 53.25, -27.90, 61040.081000, 29.2, 2, "r", 10.0, 0.60, 21.25, 40),
    (1005, 53.00, -27.65, 61077.012000, 30.0, 1, "z", -71.0, 1.10, 18.90, 77),
)
