"""Bundled cameras against the figures that observatories publish."""

import numpy as np
import pytest

import pachon
from pachon import load_camera, load_telescope
from pachon.core.units import ARCSEC

HSC, DECAM = load_camera("hsc"), load_camera("decam")


def neighbours(camera, axis):
    """Return the gaps [m] between CCDs of one angle that stand next to each other along an axis, by brute force."""
    boxes = np.array([camera.bounds([i]) for i in range(len(camera))]).reshape(-1, 2, 2)
    gaps = []
    for i, a in enumerate(boxes):
        beside = [
            b[axis, 0] - a[axis, 1]
            for j, b in enumerate(boxes)
            if i != j and b[axis, 0] >= a[axis, 1] and b[1 - axis, 0] < a[1 - axis].mean() < b[1 - axis, 1]
        ]
        if beside:
            gaps.append(min(beside))
    return np.array(gaps)


def test_hsc_has_104_ccds_with_the_published_gaps():
    assert len(HSC) == 104
    assert HSC.ccd_names[0] == "hsc000"
    assert HSC.ccd_names[-1] == "hsc103"
    assert (HSC.pixels == [2048, 4176]).all()
    assert HSC.pixel_size == 15e-6
    # Pixels of 0.17 arcsec: gaps of approximately 12 and 53 arcsec (Subaru, HSC instrument parameters).
    scale = 0.168 / 15e-6
    across, along = neighbours(HSC, 0) * scale, neighbours(HSC, 1) * scale
    assert np.median(across) == pytest.approx(12, abs=1)
    assert np.median(along) == pytest.approx(53, abs=5)
    # The row in the middle stands closer.
    assert along.min() == pytest.approx(12, abs=1)


def test_hsc_covers_the_field_of_90_arcmin():
    """The edge of the traced field passes over the outermost CCDs, and inside the circle there is little but gaps."""
    telescope = load_telescope("hsc")
    edge = np.hypot(*pachon.fields_at(telescope, [(0.24, 0.0)])[0]) / ARCSEC / 60
    radius = 0.24 * 45.0 / edge
    angle = np.linspace(0, 2 * np.pi, 721)
    x, y = np.meshgrid(*[np.linspace(-radius, radius, 400)] * 2)
    disc = np.hypot(x, y) < radius
    # 2048 x 4176 pixels on a grid of 2122.67 x 4468.33 cover 90 %; the four corners of the disc are not filled.
    assert 0.84 < np.mean(HSC.ccd_at(x[disc], y[disc]) >= 0) < 0.91
    assert np.mean(HSC.ccd_at(1.005 * radius * np.cos(angle), 1.005 * radius * np.sin(angle)) >= 0) > 0.5
    assert HSC.reach < 1.1 * radius
    assert telescope.camera == "hsc"
    # Each of the 104 reaches into the field, most with their centre.
    nearest = HSC.from_uv(
        np.arange(104)[:, None], np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 2), -1).reshape(-1, 2)
    )
    assert (np.hypot(*np.moveaxis(nearest, -1, 0)).min(axis=1) < radius).all()
    assert np.count_nonzero(np.hypot(*HSC.centers.T) < radius) > 90


def test_hsc_ccds_stand_where_the_published_picture_has_them():
    # DET-ID 49 next below the axis, 0 to 3 the column at one side, 100 to 103 turned by a quarter at the corners.
    at = {name: 1e3 * HSC.centers[HSC.ccd_index(name)] for name in ("hsc049", "hsc000", "hsc099", "hsc103", "hsc022")}
    assert np.allclose(at["hsc049"], [0.0, -33.9], atol=0.1)
    assert np.allclose(at["hsc000"], [-222.9, -104.2], atol=0.1)
    assert np.allclose(at["hsc099"], [222.9, 100.2], atol=0.1)
    assert np.allclose(at["hsc103"], [143.3, 215.0], atol=0.1)
    assert np.allclose(at["hsc022"], [-95.5, -235.0], atol=0.1)
    odd = [name for name, angle in zip(HSC.ccd_names, HSC.rotation_deg, strict=True) if angle % 180]
    assert odd == ["hsc100", "hsc101", "hsc102", "hsc103"]
    # Halves are turned towards each other.
    assert set(HSC.rotation_deg) == {0.0, 90.0, 180.0, 270.0}


def test_hsc_is_on_the_sky_as_obs_subaru_has_it():
    """In obs_subaru +x of the focal plane is along west where +y is along north (wcsFlipX is False)."""
    telescope = load_telescope("hsc")
    # Offsets x, y in pixels of CCDs of DET-ID 0, 49 and 103 (hsc_geom.paf), and their sky.
    offsets = {"hsc000": (14858.70, -6944.16), "hsc049": (0.0, -2259.16), "hsc103": (-9550.2, 14334.6)}
    sky = []
    for name in offsets:
        wcs = pachon.ccd_wcs(telescope, HSC, name)
        sky.append(wcs.to_sky([[1023.5, 2087.5]])[0] / ARCSEC / 0.17)
    offset, sky = np.array(list(offsets.values())), np.array(sky)
    # A rotation, no reflection, carries (-x, y) to (xi, eta); the distortion at the edge of the field is 4 per cent.
    ratio = (sky[:, 0] + 1j * sky[:, 1]) / (-offset[:, 0] + 1j * offset[:, 1])
    assert np.allclose(np.angle(ratio / ratio[1]), 0.0, rtol=0, atol=1e-3)
    assert np.allclose(np.abs(ratio), 0.98, rtol=0, atol=0.025)
    # The other sense would not do.
    mirrored = (sky[:, 0] + 1j * sky[:, 1]) / (offset[:, 0] + 1j * offset[:, 1])
    assert np.ptp(np.angle(mirrored / mirrored[1])) > 0.5


@pytest.mark.parametrize(("ccd", "crpix"), [("S4", 2151.2), ("N4", 2049.0 - 2151.2)])
def test_decam_is_on_the_sky_as_its_headers_have_it(ccd, crpix):
    """CRPIX1 and the CD matrix of S4 in a raw image (CCDNUM 28); those of N4 follow by symmetry."""
    header = np.array([[8.8e-9, 7.28611e-5], [-7.28567e-5, 1.04e-8]])
    wcs = pachon.wcs(load_telescope("decam"), ccd, (1.0, 0.0), np.deg2rad(-90.0))
    # The linear terms of their distortion (TPV: PV1_1, PV2_1) are 1.0056.
    assert np.allclose(wcs.wcs.cd, 1.0056 * header, rtol=0, atol=2e-3 * 7.3e-5)
    center = wcs.all_pix2world([[1024.5, 2048.5]], 1)[0] - np.rad2deg([1.0, 0.0])
    assert np.allclose(center, 1.0056 * header @ [1024.5 - crpix, 0.0], rtol=0, atol=2e-3 * 0.083)


def test_decam_is_the_published_hexagon():
    assert len(DECAM) == 62
    assert (DECAM.pixels == [2048, 4096]).all()
    # 3.0 mm between long edges, such as S4 and N4, 2.3 mm between short ones, N4 and N5 (NOIRLab, characteristics).
    box = {name: DECAM.bounds([DECAM.ccd_index(name)]) for name in ("S4", "N4", "N5")}
    assert box["N4"][0] - box["S4"][1] == pytest.approx(3.0e-3, abs=0.15e-3)
    assert box["N5"][2] - box["N4"][3] == pytest.approx(2.3e-3, abs=0.16e-3)
    # Columns of 3, 4, 5, 6, 6, 7 CCDs on either side, N and S mirror images of each other.
    columns = np.unique(np.round(DECAM.centers[:, 0] * 1e3, 3), return_counts=True)[1]
    assert columns.tolist() == [3, 4, 5, 6, 6, 7, 7, 6, 6, 5, 4, 3]
    for k in range(1, 32):
        north, south = (DECAM.centers[DECAM.ccd_index(f"{half}{k}")] for half in "NS")
        assert np.array_equal(north, south * [-1, 1])
    # N4 and S4 are the two in the middle.
    assert set(np.argsort(np.hypot(*DECAM.centers.T))[:2]) == {DECAM.ccd_index("N4"), DECAM.ccd_index("S4")}


def test_decam_fills_the_field_of_2_2_degrees():
    """The plate scale of 0.263 arcsec a pixel puts the outermost corners at the edge of the field of 1.1 deg."""
    corners = DECAM.corners(range(62)).reshape(-1, 2)
    radius = np.rad2deg(np.hypot(*corners.T).max() / 15e-6 * 0.263 * ARCSEC)
    assert radius == pytest.approx(1.1, abs=0.02)
    traced = pachon.fields_at(load_telescope("decam"), corners)
    # Distortion is below a per cent.
    assert np.rad2deg(np.hypot(*traced.T).max()) == pytest.approx(radius, rel=0.01)


def test_comcam_is_the_middle_raft_with_itl_ccds():
    comcam, lsst = load_camera("comcam"), load_camera("lsst")
    assert comcam.ccd_names == lsst.ccds_of_raft("R22")
    for name in comcam.ccd_names:
        there = lsst.centers[lsst.ccd_index(name)]
        assert np.allclose(comcam.centers[comcam.ccd_index(name)], there, rtol=0, atol=1e-16)
    assert (comcam.pixels == [4072, 4000]).all()
    assert set(comcam.vendors) == {"itl"}
    # 40 arcmin across (Rubin: 144 megapixels, 40 arcmin).
    assert 2 * comcam.reach / 10e-6 * 0.2 / 60 == pytest.approx(41.7, abs=0.1)


def test_auxtel_sees_6_7_arcmin():
    auxtel = load_camera("auxtel")
    assert auxtel.ccd_names == ("RXX_S00",)
    corners = pachon.fields_at(load_telescope("auxtel"), auxtel.corners([0])[0])
    # f/18 of 1.2 m: 0.0955 arcsec a pixel.
    assert np.ptp(corners[:, 0]) / ARCSEC == pytest.approx(4072 * 0.0955, rel=0.01)


@pytest.mark.parametrize(
    ("telescope", "camera", "site"),
    [("hsc", "hsc", "maunakea"), ("decam", "decam", "cerro_tololo"), ("comcam_r", "comcam", None),
     ("auxtel", "auxtel", None), ("lsst_v3.3_r", "lsst", None)],
)  # fmt: skip
def test_telescopes_name_their_camera_and_site(telescope, camera, site):
    model = load_telescope(telescope)
    assert (model.camera, model.site) == (camera, site)
