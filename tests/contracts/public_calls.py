"""A valid call of every public function, of constructors and of methods: tiny, to be called with wrong arguments."""

from pathlib import Path

import numpy as np
from astropy.io import fits

import pachon
from pachon import (
    design,
    imaging,
    measure,
    models,
    pipeline,
    raytrace,
    reconstruction,
    sensing,
    sky,
    studies,
    wavefront,
)

ROOT = Path(__file__).parents[2]
WAVELENGTH = 620e-9


class _Made:
    """Objects that several calls need, each made once."""

    def __init__(self, folder):
        self.folder, self._kept = folder, {}

    def __getattr__(self, name):
        if name not in self._kept:
            self._kept[name] = getattr(type(self), f"make_{name}")(self)
        return self._kept[name]

    def make_execution(self):
        return pachon.Execution(threads=1)

    def make_tel(self):
        return pachon.paul_baker()

    def make_file(self):
        path = self.folder / "telescope.yaml"
        pachon.save_telescope(self.tel, path)
        return path

    def make_visit_list_file(self):
        path = self.folder / "visits.csv"
        path.write_text(
            "visitId,ra,dec,expMidptMJD,expTime,band,rotTelPos,seeingFwhm500,airmass,night\n"
            "1,53.1,-27.8,61001.15,30,r,-35,0.72,1.05,5\n2,53.2,-27.9,61001.16,30,r,-35,0.71,1.04,5\n"
        )
        return path

    def make_visit_list(self):
        return sky.read_visit_list(self.visit_list_file)

    def make_lens(self):
        return pachon.load_telescope(ROOT / "tests" / "data" / "zmx" / "lens1.zmx")

    def make_optimization(self):
        path = self.folder / "opt.yaml"
        path.write_text("variables: [M2.dz]\n")
        return path

    def make_tolerances(self):
        path = self.folder / "tol.yaml"
        path.write_text("tolerances: [{name: M2.dz_um, size: 10}]\ndraws: 2\nrings: 2\n")
        return path

    def make_lsst(self):
        return pachon.load_telescope("lsst_v3.3_r")

    def make_rays(self):
        return pachon.launch_rays(self.tel, (0.0, 0.0), WAVELENGTH, ([3.0, -3.0], [0.0, 0.1]))

    def make_opd(self):
        return pachon.wavefront_opd(self.tel, (0.0, 0.0), WAVELENGTH, grid=16)

    def make_piff(self):
        return pachon.load_piff(ROOT / "tests/data/piff/gaussian.piff")

    def make_stamps(self):
        y, x = np.mgrid[-7:8, -7:8]
        widths = np.linspace(1.5, 2.0, 12)[:, None, None]
        return np.exp(-0.5 * (x * x + y * y) / widths**2)

    def make_places(self):
        return np.random.default_rng(1).uniform(-1.0, 1.0, (12, 2))

    def make_coloured(self):
        return pachon.PsfModel.fit(
            self.stamps, self.places, recipe="paper", n_components=2, order=0, colour=np.linspace(605e-9, 635e-9, 12)
        )

    def make_own(self):
        y, x = np.mgrid[-8:9, -8:9]
        star = 2e3 * np.exp(-0.5 * (x * x + y * y) / 1.6**2)
        return star + np.random.default_rng(3).normal(size=(12, 17, 17)) * np.sqrt(100.0 + star)

    def make_defocused(self):
        return self.lsst.perturbed("Detector", shift=(0.0, 0.0, 1.5e-3))

    def make_donuts(self):
        tiny = {"stamps": pachon.Stamps(60, pixel_size=30e-6), "electrons": 1e6, "sky": 10.0}
        air = pachon.Atmosphere.from_site(
            "cerro_pachon", seed=2, screens=pachon.ScreenSampling(screen_size=512, screen_length=40.0), exposure=0.1
        )
        return pachon.draw_donuts(self.defocused, [(0.005, 0.005)], 622e-9, atmosphere=air, **tiny)

    def make_estimate(self):
        n = len(self.dofs)
        return sensing.FreedomEstimate(self.dofs, np.zeros(n), np.eye(n), np.ones(n))

    def make_model(self):
        return pachon.PsfModel.fit(self.stamps, self.places, n_components=2, order=1)

    def make_shear_psf(self):
        y, x = np.mgrid[-7:8, -7:8]
        psf = np.exp(-0.5 * (x * x + y * y) / 1.5**2)
        return psf / psf.sum()

    def make_estimator(self):
        return measure.ShearEstimator(self.shear_psf, 1e-6, 0.1, sigma=2.6e-6, side=40)

    def make_shear_shapes(self):
        e1, e2, r11, r12, r22, weight, snr = np.random.default_rng(6).uniform(0.1, 0.2, (7, 12))
        return measure.ShearShapes(e1, e2, r11, 0.1 * r12, r22, weight, snr)

    def make_floating(self):
        return pachon.load_telescope("paul_baker").with_design(stop="M1", aperture="f_number", aperture_value=4.0)

    def make_spots(self):
        return pachon.spots(self.tel, [(0.0, 0.0)], n_pupil=3)

    def make_image(self):
        rng = np.random.default_rng(2)
        image = rng.normal(0.0, 1.0, (96, 128))
        y, x = np.indices(image.shape)
        for i in range(15):
            cx, cy = 12 + 25 * (i % 5), 16 + 30 * (i // 5)
            image += 500.0 * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / 2.0**2)
        return image

    def make_objects(self):
        return pachon.detect_objects(self.image, np.ones_like(self.image), background_size=None)

    def make_fits(self):
        return pachon.fit_galaxies(
            self.image, np.ones_like(self.image), [12.0], [16.0], self.stamps[0] / self.stamps[0].sum(),
            half_light_radius=[2.4],
        )  # fmt: skip

    def make_galaxies(self):
        return sky.Galaxies.single([0.0, 1e-5], [0.0, 1e-5], [22.0, 23.0], [2e-6, 3e-6])

    def make_plane(self):
        return pachon.FocalPlane.flat("lsst")

    def make_camera(self):
        return pachon.lsst_camera()

    def make_silicon(self):
        return models.Silicon()

    def make_grid(self):
        axis = np.linspace(-5.0, 5.0, 9)
        return models.GridSag(axis, axis, 1e-6 * np.add.outer(axis, axis))

    def make_cube(self):
        import trimesh

        return trimesh.creation.box((0.1, 0.1, 0.1))

    def make_dofs(self):
        return models.DegreesOfFreedom.of_parameters(self.tel, ["M2.dz"])

    def make_air(self):
        screens = pachon.ScreenSampling(screen_size=1024, screen_length=560.0)
        return pachon.Atmosphere.from_site("cerro_pachon", 1, exposure=0.5, time_step=0.5, screens=screens)

    def make_correlation(self):
        return pachon.shear_correlation(**self.columns, bins=pachon.SeparationBins(1e-3, 1e-1, 3))

    def make_columns(self):
        rng = np.random.default_rng(4)
        names = ("x", "y", "e1", "e2")
        return dict(zip(names, rng.uniform(-0.02, 0.02, (4, 30)), strict=True))

    def make_aberration(self):
        return wavefront.ResidualWavefront.draw(self.tel)

    def make_config(self):
        return pachon.Configuration(telescope="none.yaml")

    def make_baseline(self):
        return studies.read_baseline(ROOT / "studies/baseline/bundled/lsst_v3.3_r.baseline.json")

    def make_sweep(self):
        return studies.load_sweep(ROOT / "studies/sweep/examples/table1_small.yaml")

    def make_ccd_image(self):
        mask = np.zeros(self.image.shape, int)
        return imaging.CcdImage("R22_S11", self.image, np.ones_like(self.image), mask, fits.Header({"ZEROPNT": 27.0}))

    def make_table(self):
        third = [0.0, 1e-3, 2e-3]
        return {"ccd": ["R22_S11"] * 3, "x": third, "y": third, "e1": [0.0] * 3, "e2": [0.0] * 3, "size": [2e-6] * 3,
                "snr": [50.0] * 3}  # fmt: skip

    def make_stars(self):
        return pachon.FocalPlaneStars.from_table(self.table)

    def make_experiment(self):
        config = pachon.Configuration(
            ccds=("R22_S11",), wavelengths_nm=(620.0,), psf={"engine": "long_exposure", "n_pupil": 60}
        )
        return pachon.Experiment.from_config(config)


def calls(folder):
    """Return the calls: callable and keyword arguments by label."""
    m = _Made(folder)
    tel, w = m.tel, WAVELENGTH
    on_axis = np.zeros((1, 2))
    x, y = np.linspace(-1.0, 1.0, 4), np.linspace(0.0, 1.0, 4)
    radius = tel.pupil_diameter / 2
    psf = m.stamps[0] / m.stamps[0].sum()
    flat = np.ones_like(m.image)
    shear = np.full((4, 6), 0.1) + np.linspace(-0.01, 0.01, 6)
    design_call = {"telescope": tel, "fields": on_axis, "projection": "zemax", "threads": 1}
    waves = design_call | {"wavelengths": [w], "wavelength_weights": [1.0]}
    mono = design_call | {"wavelength": w}
    images = {"telescope": tel, "fields": on_axis, "wavelengths": [w], "threads": 1}
    one = {"telescope": tel, "wavelength": w, "projection": "zemax", "threads": 1}
    pairs = m.columns | {"bins": pachon.SeparationBins(1e-3, 1e-1, 3, exact=False)}
    sizes = {"size": np.full(30, 1e-6), "model_e1": pairs["e1"] * 0.9, "model_e2": pairs["e2"] * 0.9,
             "model_size": np.full(30, 1.1e-6)}  # fmt: skip
    made = {
        "fft_psf": (pachon.fft_psf, images | {"pixel": 1e-6, "pixels": 16, "n_pupil": 48,
                    "reference": "centroid"}),
        "huygens_psf": (pachon.huygens_psf, images | {"pixel": 1e-6, "pixels": 8,
                        "sampling": "square", "n_pupil": 8, "reference": "centroid"}),
        "encircled_energy": (pachon.encircled_energy, images | {"kind": "geometric",
                             "radii": [1e-6, 2e-6], "reference": "centroid", "n_pupil": 50}),
        "StarDefects": (pipeline.StarDefects, {"second_stars": 0.1, "cosmic_rays": 0.1}),
        "Requirements": (studies.Requirements, {"tolerances": ["1 %"], "limits": ["spot rms < 10 um"]}),
        "Reflectivity": (design.Reflectivity, {"lenses": {"L1_exit": 0.01}, "detector": 0.1}),
        "energy_curve": (design.energy_curve, {"image": m.stamps[0], "center": (7.0, 7.0), "parts": 2}),
        "mtf": (pachon.mtf, waves | {"n_pupil": 48}),
        "layout": (pachon.layout, mono),
        "ray_fans": (pachon.ray_fans, design_call | {"wavelengths": [w], "n_points": 3}),
        "opd_fans": (design.opd_fans, design_call | {"wavelengths": [w], "n_points": 3, "sphere_radius": -5.0}),
        "field_curvature": (pachon.field_curvature, design_call | {"wavelengths": [w]}),
        "lateral_color": (design.lateral_color, design_call | {"wavelengths": [w, 7e-7]}),
        "chromatic_focus": (design.chromatic_focus, {"telescope": tel, "wavelengths": [w], "zones": [0.7],
                            "threads": 1}),
        "seidel_diagram": (design.seidel_diagram, {"telescope": tel, "wavelength": w, "field": 0.005}),
        "relative_illumination": (design.relative_illumination, mono | {"n_pupil": 16}),
        "throughput": (design.throughput, design_call | {"wavelengths": [w], "sampling": "gauss", "n_pupil": 3,
                       "coatings": design.Coatings({"M1": models.Coating((5e-7, 7e-7), (0.9, 0.95))})}),
        "fresnel_transmission": (design.fresnel_transmission, {"cosine": [1.0, 0.9], "n1": 1.0, "n2": 1.5}),
        "spot_matrix": (design.spot_matrix, design_call | {"wavelengths": [w], "against": "focus",
                        "defocus": [0.0, 1e-5], "sampling": "rings", "n_pupil": 2}),
        "bar_target": (design.bar_target, {"pixels": 16, "bars": 2}),
        "target_image": (design.target_image, {"telescope": tel, "target": np.eye(4), "width": 1e-5,
                         "field": (0.0, 0.0), "wavelengths": [w], "n_rays": 4,
                         "pixel": 1e-5, "pixels": 8, "projection": "zemax", "threads": 1}),
        "strehl": (pachon.strehl, design_call | {"wavelengths": [w], "from_psf": False, "sampling": "gauss",
                   "n_pupil": 3}),
        "chromatic_sums": (models.chromatic_sums, {"telescope": tel, "wavelengths": [5e-7, w], "field": 0.005}),
        "fringe_zernikes": (models.fringe_zernikes, {"jmax": 9, "x": 0.5 * x, "y": 0.5 * y}),
        "fringe_from_noll": (models.fringe_from_noll, {"coefficients": [1e-9, 2e-9]}),
        "noll_from_fringe": (models.noll_from_fringe, {"coefficients": [1e-9, 2e-9]}),
        "distortion": (pachon.distortion, mono | {"fields": 0.003 * np.eye(4, 2), "reference": "chief", "n_pupil": 3,
                       "sampling": "gauss"}),
        "double_zernikes": (design.double_zernikes, {"telescope": tel, "wavelength": w, "jmax": 6, "kmax": 3,
                            "rings": 2, "n_pupil": 6, "field_radius": tel.field_radius, "pupil": "full",
                            "sampling": "gauss", "threads": 1}),
        "wavefront_zernikes": (pachon.wavefront_zernikes, mono | {"jmax": 6, "pupil": "full", "ordering": "noll",
                               "sampling": "gauss", "n_pupil": 6}),
        "footprint": (pachon.footprint, mono | {"surfaces": ["M2"], "sampling": "rings", "n_pupil": 3}),
        "ghosts": (pachon.ghosts, {"telescope": m.lsst, "field": (0.0, 0.0), "wavelength": w,
                   "reflectivity": design.Reflectivity(0.01), "n_pupil": 400, "projection": "zemax", "threads": 1}),
        "principal_rays": (design.principal_rays, mono),
        "spots": (pachon.spots, waves | {"sampling": "gauss", "n_pupil": 3, "reference": "centroid"}),
        "through_focus": (pachon.through_focus, waves | {"defocus": [-1e-5, 0.0, 1e-5], "sampling": "gauss",
                          "n_pupil": 3}),
        "vignetting": (pachon.vignetting, mono | {"n_pupil": 64}),
        "monte_carlo": (pachon.monte_carlo, {"telescope": tel, "tolerances": [pachon.Tolerance("M2.dz", 1e-5)],
                        "merit": "spots", "n": 2, "seed": 1, "method": "linear", "fields": on_axis,
                        "compensators": []}),
        "wavefronts": (design.wavefronts, {"telescope": tel, "rays": design.Beams.of(tel, on_axis, [w], n_pupil=3)}),
        "process_workers": (pachon.process_workers, {"compute": len, "count": 2, "threads": 2}),
        "optimize": (pachon.optimize, {"telescope": tel, "fields": on_axis, "wavelengths": [w], "threads": 1,
                     "variables": ["M2.dz"], "merit": "spots", "n_pupil": 3, "bounds": {"M2.dz": (-1e-3, 1e-3)},
                     "targets": []}),
        "operand": (pachon.operand, {"name": "EFLY", "value": 10.0, "weight": 1.0}),
        "with_vignetting_factors": (wavefront.with_vignetting_factors, {"telescope": m.lens}),
        "SpotSize": (design.SpotSize, {"reference": "chief"}),
        "WavefrontError": (design.WavefrontError, {"goal": np.zeros((1, 1, 3))}),
        "LeastSquares": (design.LeastSquares, {"tolerance": 1e-9, "max_steps": 5, "restarts": 1, "spread": 0.2,
                         "seed": 1}),
        "choose_glasses": (design.choose_glasses, {"telescope": m.lens, "variables": ["Image.dz"], "glasses": ["N-SF2"],
                           "merit": "spots", "nearest": 1}),
        "load_optimization": (design.load_optimization, {"path": m.optimization}),
        "load_tolerances": (studies.load_tolerances, {"path": m.tolerances, "telescope": "paul_baker"}),
        "run_tolerances": (pachon.run_tolerances, {"telescope": tel,
                           "file": studies.load_tolerances(m.tolerances, "paul_baker")}),
        "sensitivity": (pachon.sensitivity, mono | {"parameters": ["M2.dz"], "n_zernike": 6,
                        "sampling": "gauss", "n_pupil": 6}),
        "apply_changes": (models.apply_changes, {"telescope": m.lsst, "changes": {"M2.dz_um": 1.0}}),
        "load_degrees_of_freedom": (pachon.load_degrees_of_freedom, {"name_or_path": "lsst"}),
        "read_grid": (models.read_grid, {"path": m.folder / "none.fits"}),
        "read_hdf5_map": (models.read_hdf5_map, {"path": m.folder / "none.h5", "half_width": 1.0, "unit": 1e-6,
                          "dataset": "map", "quarter_turns": 1}),
        "thermal": (models.thermal, {"telescope": tel, "expansion": 1e-6, "dn_dt": {}}),
        "load_images_configuration": (imaging.load_images_configuration, {"path": m.folder / "none.yaml"}),
        "load_piff": (pachon.load_piff, {"path": m.folder / "none.piff"}),
        "PiffPsf.at": (m.piff.at, {"positions": [(10.0, 20.0)], "size": 5, "properties": {}}),
        "PiffPsf.draw": (m.piff.draw, {"x": 10.0, "y": 20.0, "size": 5}),
        "compare_with_piff": (reconstruction.compare_with_piff, {"psf": m.piff, "stamps": m.own,
                              "positions": 1000.0 + 900.0 * m.places, "pixel_scale": 1e-6, "bins": 3}),
        "wcs": (pachon.wcs, {"telescope": m.lsst, "ccd": "R22_S11", "pointing": (0.0, 0.0), "rotation": 0.1,
                "camera": "lsst", "wavelength": w, "threads": 1}),
        "Pointing": (pachon.Pointing, {"ra": 1.0, "dec": 0.5, "position_angle": 0.1}),
        "Pointing.to_sky": (pachon.Pointing(1.0, 0.5).to_sky, {"slopes": on_axis}),
        "Pointing.to_slopes": (pachon.Pointing(1.0, 0.5).to_slopes, {"sky": on_axis}),
        "Pointing.to_celestial": (pachon.Pointing(1.0, 0.5).to_celestial, {"sky": on_axis}),
        "Pointing.from_celestial": (pachon.Pointing(1.0, 0.5).from_celestial, {"ra": [1.0], "dec": [0.5]}),
        "ccd_wcs": (pachon.ccd_wcs, {"telescope": m.lsst, "camera": m.camera, "ccd": "R22_S11", "pointing": (0.0, 0.0),
                    "position_angle": 0.0, "wavelength": w, "threads": 1}),
        "load_camera": (pachon.load_camera, {"camera": "comcam"}),
        "lsst_camera": (pachon.lsst_camera, {}),
        "height_statistics": (models.height_statistics, {"focal_plane": m.plane}),
        "new_telescope": (pachon.new_telescope, {"kind": "cassegrain", "diameter": 1.0, "f_number": 8.0,
                          "field_radius": 0.003, "primary_f_number": 2.5, "back_focus": 0.2}),
        "two_mirror": (models.two_mirror, {"kind": "cassegrain", "diameter": 1.0, "f_number": 8.0,
                       "field_radius": 0.003, "primary_f_number": 2.5, "back_focus": 0.2}),
        **{kind.__name__: (kind, {"diameter": 0.1, "f_number": 8.0, "field_radius": 0.01})
           for kind in (models.newtonian, models.schmidt, models.singlet, models.doublet, models.triplet)},
        "design_report": (pachon.design_report, {"telescope": tel, "fields": np.full((1, 2), 9.0), "wavelengths": [w],
                          "threads": 1}),
        "validate_file": (pachon.validate_file, {"path": m.folder / "none.yaml"}),
        "file_schema": (studies.file_schema, {"kind": "site"}),
        "first_order": (pachon.first_order, {"telescope": tel, "wavelength": w}),
        "parabasal_optics": (models.parabasal_optics, {"telescope": tel, "wavelength": w}),
        "with_floating_pupil": (models.with_floating_pupil, {"telescope": m.floating}),
        "seidel_sums": (pachon.seidel_sums, {"telescope": tel, "wavelength": w, "field": 0.01}),
        "corner_sensors": (models.corner_sensors, {"name": "lsstcam"}),
        "load_telescope": (pachon.load_telescope, {"name_or_path": m.file, "lenient": False, "glass_catalogues": []}),
        "save_telescope": (pachon.save_telescope, {"telescope": tel, "path": m.folder / "saved.yaml"}),
        "load_site": (models.load_site, {"name_or_path": "cerro_pachon"}),
        "model_glass": (models.model_glass, {"nd": 1.5168, "vd": 64.2, "partial_dispersion": 0.0}),
        "paul_baker": (pachon.paul_baker, {"diameter": 8.4, "focal_ratio": 4.0, "beam_compression": 0.26,
                       "field_radius": 0.008}),
        "annular_zernikes": (models.annular_zernikes, {"jmax": 6, "x": x, "y": y, "obscuration": 0.5}),
        "detect_objects": (pachon.detect_objects, {"image": m.image, "variance": flat,
                           "mask": np.zeros(flat.shape, int), "saturated": 0, "threshold": 3.0, "min_area": 5,
                           "kernel": np.ones((3, 3)), "deblend_levels": 32, "deblend_contrast": 0.005,
                           "background_size": 32}),
        "fit_galaxies": (pachon.fit_galaxies, {"image": m.image, "variance": flat, "x": [12.0, 37.0], "y": [16.0, 16.0],
                         "psf_images": psf, "half_light_radius": [2.4, 2.4], "mask": np.zeros(flat.shape, int),
                         "segmentation": m.objects.segmentation, "solver": measure.LevenbergMarquardt(5, 1e-3),
                         "threads": 1}),
        "fit_galaxy_stamps": (measure.fit_galaxy_stamps, {"stamps": m.stamps[:2], "variance": np.ones((2, 15, 15)),
                              "psf_images": psf, "mask": np.zeros((2, 15, 15), int),
                              "solver": measure.LevenbergMarquardt(5, 1e-3), "threads": 1}),
        "usable_galaxies": (measure.usable_galaxies, {"fits": m.fits, "half_light_radius": [3.0],
                            "star_half_light_radius": [2.0], "least_ratio": 1.2, "most_error": 0.2}),
        "detection_rates": (measure.detection_rates, {"magnitude": [20.1, 21.2], "match": [0, 1],
                            "true_magnitude": [20.0, 21.0, 22.0], "edges": [19.0, 21.5, 23.0]}),
        "match_positions": (measure.match_positions, {"x": x, "y": y, "true_x": x, "true_y": y, "radius": 0.1}),
        "shear_calibration": (measure.shear_calibration, {"e1": shear, "e2": shear, "shear1": [0.0, 0.01, 0.02, 0.03],
                              "shear2": [0.0, 0.01, -0.02, 0.03]}),
        "detect_shear": (measure.detect_shear, {"image": m.image, "psf_images": m.shear_psf, "pixel_scale": 1e-6,
                         "noise": 1.0, "psf_positions": [[10.0, 10.0]], "mask": np.zeros(flat.shape, int), "seed": 1,
                         "sigma": 2.6e-6, "min_snr": 10.0, "threads": 1}),
        "CorrelatedNoise": (measure.CorrelatedNoise, {"rms": 1.0,
                            "correlation": [[0, 0.1, 0], [0, 1, 0], [0, 0.1, 0]]}),
        "CorrelatedNoise.of_image": (measure.CorrelatedNoise.of_image, {
            "image": np.random.default_rng(1).standard_normal((40, 40)), "mask": np.zeros((40, 40), int), "reach": 1}),
        "mean_shear": (measure.mean_shear, {"shapes": m.shear_shapes, "patch": np.arange(12) // 3}),
        "shear_bias": (measure.shear_bias, {"plus": m.shear_shapes, "minus": m.shear_shapes, "shear1": 0.01,
                       "shear2": 0.0, "patch": np.arange(12) // 3, "minus_patch": np.arange(12) // 3}),
        "LocusSearch": (measure.LocusSearch, {"bright_snr": 60.0, "min_stars": 3, "radius_range": (1.0, 9.0)}),
        "select_stars": (pachon.select_stars, {"objects": m.objects, "image": m.image, "min_snr": 30.0,
                         "n_sigma": 4.0, "max_ellipticity": 0.1, "isolation": 5.0,
                         "locus": measure.LocusSearch(min_stars=3),
                         "size": 15, "mask": np.zeros(flat.shape, int)}),
        "load_configuration": (pipeline.load_configuration, {"path": m.folder / "none.yaml"}),
        "SeparationBins": (pachon.SeparationBins, {"min_sep": 1e-3, "max_sep": 1e-1, "n_bins": 3, "exact": False}),
        "shear_correlation": (pachon.shear_correlation, pairs | {"subtract_mean": False,
                              "patch": np.repeat([0, 1, 2], 10)}),
        "rho_statistics": (pachon.rho_statistics, pairs | sizes | {"patch": np.repeat([0, 1, 2], 10)}),
        "measure_shapes": (pachon.measure_shapes, {"images": m.stamps, "pixel_scale": 1e-6, "weight_fwhm": 4e-6,
                           "background": 0.0, "max_iterations": 5, "tolerance": 1e-4,
                           "centers": np.zeros((len(m.stamps), 2))}),
        "adaptive_moments": (pachon.adaptive_moments, {"images": m.stamps, "pixel_scale": 1e-6,
                             "mask": np.zeros(m.stamps.shape, bool), "weight": np.ones(m.stamps.shape),
                             "start_sigma": 2e-6, "max_iterations": 60, "tolerance": 1e-4}),
        "load_stars": (pachon.load_stars, {"catalogue": m.folder / "none.fits", "x": "x", "y": "y", "stamp": "stamp"}),
        "center_stamps": (measure.center_stamps, {"images": m.stamps, "x": np.zeros(12), "y": np.zeros(12), "size": 11,
                          "normalize": True, "weights": np.ones(m.stamps.shape, bool)}),
        "flag_stars": (measure.flag_stars, {"stamps": m.stamps, "noise": 0.01, "gain": 1.0, "saturation": 10.0,
                       "threshold": 6.0}),
        "corner_focal_plane": (models.corner_focal_plane, {"kind": "guider", "heights": "nominal"}),
        "corner_stars": (pachon.corner_stars, {"telescope": m.lsst, "kind": "guider", "heights": "nominal", "n": 1,
                         "wavelength": 622e-9}),
        "draw_donuts": (pachon.draw_donuts, {"telescope": m.lsst, "fields": [(0.005, 0.005)],
                        "wavelengths": 622e-9, "model": pachon.DonutModel(air=pachon.DonutAir(fwhm=3e-6)),
                        "electrons": 1e6, "sky": 10.0, "read_noise": 5.0, "defects": pipeline.StarDefects(),
                        "seed": 1, "stamps": pachon.Stamps(181)}),
        "fit_donuts": (pachon.fit_donuts, {"telescope": m.defocused, "images": m.donuts.images,
                       "fields": [(0.005, 0.005)], "wavelength": 622e-9, "pixel_size": 30e-6, "sky_variance": 10.0,
                       "model": pachon.DonutModel(air=pachon.DonutAir(fwhm=3e-6), n_pupil=60),
                       "moved": "M2", "fit": sensing.SingleDonuts((4, 5)),
                       "mask": np.zeros(m.donuts.images.shape, bool), "projection": "zemax", "threads": 1}),
        "DonutModel": (pachon.DonutModel, {"light": None, "air": pachon.DonutAir(), "detector": pachon.DonutDetector(),
                       "rims": sensing.DonutRims(), "neighbours": True, "diffraction": False, "n_pupil": 60}),
        "DonutRims": (sensing.DonutRims, {"search": True, "size": 0.01}),
        "DonutAir": (pachon.DonutAir, {"fwhm": [3e-6], "outer_scale": 25.0, "atmosphere": None}),
        "DonutDetector": (pachon.DonutDetector, {"pixel_size": 30e-6, "diffusion": 0.0, "focal_plane": None,
                          "defocus": [0.0], "saturation": 1e7, "moved": "M2",
                          "response_slope": 1e-5}),
        "DonutFrames": (sensing.DonutFrames, {"rotator": 0.1, "parallactic_angle": 0.2, "stamp_axes": "y,x"}),
        "hexapod_corrections": (sensing.hexapod_corrections, {"degrees_of_freedom": m.estimate, "frame": "ZCS",
                                "frames": sensing.DonutFrames()}),
        "check_orientation": (sensing.check_orientation, {"telescope": m.defocused, "images": m.donuts.images,
                              "fields": [(0.005, 0.005)], "wavelength": 622e-9, "sky_variance": 10.0,
                              "model": pachon.DonutModel(detector=pachon.DonutDetector(pixel_size=30e-6)),
                              "mask": [np.zeros(i.shape, bool) for i in m.donuts.images], "projection": "zemax",
                              "donuts": 1, "threads": 1}),
        "SingleDonuts": (sensing.SingleDonuts, {"noll": (4, 5), "left_out": 0.0, "higher_order": 0.0}),
        "ExposureDonuts": (sensing.ExposureDonuts, {"field_noll": (1, 2), "noll": (4, 5), "higher_order": 0.0,
                           "freedoms": m.dofs, "prior": [1e-5], "stars": [0, 0]}),
        "FieldTerms": (sensing.FieldTerms, {"field_noll": (1, 2), "noll": (4, 5), "higher_order": 0.0}),
        "TelescopeFreedoms": (sensing.TelescopeFreedoms, {"freedoms": m.dofs, "prior": [1e-5], "noll": (4, 5)}),
        "align": (studies.align, {"config": studies.AlignConfig(telescope="none.yaml"), "execution": m.execution}),
        "load_align_configuration": (studies.load_align_configuration, {"path": m.folder / "none.yaml"}),
        "fit_own_stars": (pachon.fit_own_stars, {"stamps": m.own, "positions": m.places,
                          "pixel_scale": 1e-6, "size": 11, "min_snr": 1.0, "gain": 1.0, "saturation": 1e7,
                          "background": False, "extent": (-1.0, 1.0, -1.0, 1.0), "masks": None, "seed": 1}),
        "brighter_fatter": (pipeline.brighter_fatter, {"images": m.stamps, "electrons": np.full(12, 1e4),
                            "sensor": "itl", "sky": 10.0}),
        "displace_stamps": (pipeline.displace_stamps, {"images": m.stamps, "places": m.places * 1e-3,
                            "pixel_size": 1e-5, "effects": [pipeline.EdgeRolloff(1e-6, 1e-4, 2e-2)]}),
        "land_on_mesh": (raytrace.land_on_mesh, {"detector": tel.surfaces[-1], "mesh": m.cube, "threads": 1,
                         "position": np.array([[0.0, 0.0, -1.0]]), "direction": np.array([[0.0, 0.0, 1.0]])}),
        "launch_rays": (pachon.launch_rays, {"telescope": tel, "field": (0.0, 0.0), "wavelength": w, "pupil": (x, y),
                        "projection": "zemax", "aiming": "off"}),
        "intersect": (pachon.intersect, {"surface": tel.surfaces[0], "rays": m.rays, "n": 1.0}),
        "reflect": (pachon.reflect, {"surface": tel.surfaces[0], "rays": m.rays, "n": 1.0}),
        "refract": (pachon.refract, {"surface": tel.surfaces[0].shape, "rays": m.rays, "n1": 1.0, "n2": 1.5}),
        "Surface.sag": (tel.surfaces[0].sag, {"x": x, "y": y}),
        "Surface.normal": (tel.surfaces[0].normal, {"x": x, "y": y}),
        "trace": (pachon.trace, {"telescope": tel, "rays": m.rays, "threads": 1, "out": pachon.trace(tel, m.rays)}),
        "read_galaxies": (sky.read_galaxies, {"path": m.folder / "none.fits", "pointing": (0.0, 0.0),
                          "convention": "galsim", "band": "r"}),
        "to_sky": (pachon.to_sky, {"shapes": [[0.1, 0.0]], "x": [10.0], "y": [20.0],
                   "wcs": pachon.wcs(m.lsst, "R22_S11", (0.0, 0.0), camera="lsst")}),
        "write_galaxies": (sky.write_galaxies, {"path": m.folder / "galaxies.ecsv", "galaxies": m.galaxies}),
        "draw_galaxies": (pachon.draw_galaxies, {"region": ((-1e-4, 1e-4), (-1e-4, 1e-4)), "faintest": 24.0, "seed": 1,
                          "brightest": 20.0, "density": 1.0}),
        "check_baseline": (pachon.check_baseline, {"path": m.folder / "none.json", "threads": 1}),
        "assert_matches_baseline": (pachon.testing.assert_matches_baseline, {"model": m.file, "threads": 1,
                                    "baseline": m.folder / "none.json"}),
        "make_baseline": (pachon.make_baseline, {"model": str(m.folder / "none.yaml"), "folder": m.folder,
                          "requirements": studies.Requirements()}),
        "Baseline.with_sources": (m.baseline.with_sources, {"sources": {"opd": "a peer"}}),
        "read_baseline": (studies.read_baseline, {"path": m.folder / "none.json"}),
        "write_baseline": (studies.write_baseline, {"path": m.folder / "b.json", "baseline": m.baseline}),
        "load_sweep": (studies.load_sweep, {"path": m.folder / "none.yaml"}),
        "load_sweep_table": (studies.load_sweep_table, {"path": m.folder / "none.db"}),
        "run_sweep": (pachon.run_sweep, {"sweep": m.sweep, "path": m.file, "execution": m.execution}),
        "open_desk": (pachon.open_desk, {"source": "none"}),
        "run": (pachon.run, {"config": m.config, "folder": m.folder / "none", "strict": False,
                             "execution": m.execution}),
        "simulate_images": (pachon.simulate_images, {"config": imaging.ImagesConfig(run=m.config),
                            "execution": m.execution, "folder": m.folder / "none"}),
        "stack_visits": (pachon.stack_visits, {"config": studies.VisitsConfig(run=m.config),
                         "execution": m.execution, "folder": m.folder / "none"}),
        "null_test": (studies.null_test, {"folder": m.folder / "none", "tiles": 2, "rings": 10,
                      "execution": m.execution}),
        "run_night": (studies.run_night, {"config": studies.NightConfig(run=m.config), "base": m.folder, "part": (1, 1),
                      "execution": m.execution, "folder": m.folder / "none"}),
        "load_night_configuration": (studies.load_night_configuration, {"path": m.folder / "none.yaml"}),
        "read_visit_list": (sky.read_visit_list, {"path": m.visit_list_file, "where": "airmass < 1.4",
                            "band": "r", "night": 5, "camera": "lsst", "site": "cerro_pachon",
                            "airmass_law": "opsim"}),
        "load_visits_configuration": (studies.load_visits_configuration, {"path": m.folder / "none.yaml"}),
        "shim": (studies.shim, {"experiment": m.experiment, "merit": "fwhm", "parts": "rafts", "threads": 1}),
        "measure_image": (
            pachon.measure_image,
            {
                "image": m.ccd_image,
                "psf": None,
                "recipe": "kriging",
                "stars": None,
                "colours": None,
                "min_snr": 30.0,
                "threads": 1,
            },
        ),
        "ObjectColours": (imaging.ObjectColours, {"positions": np.zeros((2, 2)), "values": np.array([0.5, np.nan])}),
        "ImageSettings": (imaging.ImageSettings, {"weight": m.folder / "none.fits", "weight_kind": "rms",
                          "mask": m.folder / "none.fits", "gain": 2.0, "zero_point": 30.0, "pixel_scale": 1e-6,
                          "saturation": 5e4}),
        "load_image": (pachon.load_image, {"path": m.folder / "none.fits", "extension": "1",
                       "settings": imaging.ImageSettings()}),
        "load_psfex": (reconstruction.load_psfex, {"path": m.folder / "none.fits"}),
        "PsfexPsf.at": (reconstruction.PsfexPsf(np.ones((1, 9, 9)), 1.0, 0, np.zeros(2), np.ones(2)).at,
                        {"positions": [[3.0, 4.0]], "size": 5}),
        "focal_plane_stars": (
            imaging.focal_plane_stars,
            {"images": [m.ccd_image], "weight_fwhm": 0.7 / 206265.0, "min_snr": 30.0},
        ),
        "draw_ccd": (pachon.draw_ccd, {"experiment": m.experiment, "ccd": "none", "galaxies": m.galaxies,
                     "pointing": (0.0, 0.0), "threads": 1}),
        "fit_static_heights": (reconstruction.fit_static_heights, {"exposures": [], "telescope": tel, "steps": 1,
                               "prior": reconstruction.OpticsPrior("simulated", 1e-7), "threads": 1}),
        "fields_at": (pachon.fields_at, {"telescope": tel, "positions": [(0.0, 0.0), (0.01, 0.0)], "wavelength": w,
                      "projection": "zemax", "threads": 1}),
        "wavefront_opd": (pachon.wavefront_opd, one | {"field": (0.0, 0.0), "pupil": (x, y), "reference": "chief"}),
        "wavefront_opds": (pachon.wavefront_opds, one | {"fields": on_axis, "grid": 8}),
        "make_psfs": (pachon.make_psfs, {"telescope": tel, "fields": on_axis, "wavelengths": pachon.Light([w], [1.0]),
                      "engine": pachon.FastEngine(n_pupil=40), "stamps": pachon.Stamps(15), "atmosphere": None,
                      "threads": 1}),
        "psf_moments": (pachon.psf_moments, {"telescope": tel, "fields": on_axis, "wavelengths": [w],
                        "atmosphere": None, "engine": pachon.LongExposureEngine(20), "weight_fwhm": 2e-6,
                        "threads": 1}),
        "blackbody_photons": (pachon.blackbody_photons, {"temperature": [3500.0, 6000.0], "wavelengths": [w]}),
        "effective_colour": (pachon.effective_colour, {"wavelengths": [600e-9, w], "photons": [[1.0, 2.0], [1.0, 1.0]],
                             "kind": "g_i"}),
        "color_temperature": (models.color_temperature, {"color": [0.4, 1.2], "bands": "g_r"}),
        "pupil_sampling": (pachon.pupil_sampling, {"telescope": tel, "sampling": "gauss", "n_pupil": 3}),
        "field_points": (wavefront.field_points, {"telescope": tel, "fields": on_axis}),
        "focus_height": (wavefront.focus_height, {"telescope": m.lsst, "silicon": m.silicon, "wavelength": w,
                         "threads": 1}),
        "fit_zernikes": (pachon.fit_zernikes, {"opd": m.opd, "pupil_radius": radius, "jmax": 6,
                         "obscuration": tel.pupil_obscuration}),
    }  # fmt: skip
    return made | _methods(m, tel, w, x, y)


def _methods(m, tel, w, x, y):
    """Constructors and methods."""
    xy = {"x": x, "y": y}
    out = {
        "FocalLength": (design.FocalLength, {"value": 10.0, "weight": 1.0, "wavelength": w}),
        "ImageScale": (design.ImageScale, {"value": 10.0, "weight": 1.0, "wavelength": w}),
        "FNumber": (design.FNumber, {"value": 4.0, "weight": 1.0, "wavelength": w}),
        "ChiefRay": (design.ChiefRay, {"field": (0.0, 0.001), "axis": "y", "wavelength": w, "value": 0.03}),
        "RelativeDistortion": (design.RelativeDistortion, {"field": (0.0, 0.001), "wavelength": w, "maximum": 0.01}),
        "BackFocus": (design.BackFocus, {"wavelength": w, "minimum": 0.1}),
        "CenterThickness": (design.CenterThickness, {"surface": "M1", "minimum": 0.1, "maximum": 0.2, "weight": 1.0}),
        "EdgeThickness": (design.EdgeThickness, {"surface": "M1", "radius": 1.0, "minimum": 0.1}),
        "SagAt": (design.SagAt, {"surface": "M1", "radius": 1.0, "value": 0.1}),
        "TotalLength": (design.TotalLength, {"first": "M1", "last": "M2", "maximum": 20.0}),
        "IncidenceAngle": (design.IncidenceAngle, {"surface": "M1", "field": (0.0, 0.001), "pupil": (0.0, 1.0),
                           "wavelength": w, "maximum": 0.5}),
        "ExitAngle": (design.ExitAngle, {"surface": "M1", "field": (0.0, 0.001), "maximum": 0.5}),
        "RmsSpot": (design.RmsSpot, {"field": (0.0, 0.001), "wavelengths": (w,), "n_pupil": 3, "maximum": 1e-5}),
        "RmsWavefront": (design.RmsWavefront, {"field": (0.0, 0.001), "n_pupil": 3, "maximum": 1e-7}),
        "WavefrontMtf": (design.WavefrontMtf, {"field": (0.0, 0.001), "frequency": 1e4, "angle": 0.0, "wavelength": w,
                         "minimum": 0.5}),
        "DesignConfiguration": (design.DesignConfiguration, {"telescope": tel, "weight": 1.0, "operands": ()}),
        "Tolerance": (pachon.Tolerance, {"name": "M2.dz", "size": 1e-5, "distribution": "uniform"}),
        "Tolerance.draw": (pachon.Tolerance("a", 1.0).draw, {"seed": 1, "n": 3}),
        "Parameter.parse": (models.Parameter.parse, {"text": "M2.dz", "telescope": tel}),
        "DegreesOfFreedom.of_parameters": (models.DegreesOfFreedom.of_parameters, {"telescope": tel,
                                           "addresses": ["M2.dz"]}),
        "OpticsState": (models.OpticsState, {"values": {"M2_dz": 10.0}}),
        "OpticsState.telescope": (models.OpticsState({"M2_dz": 10.0}).telescope, {"nominal": m.lsst}),
        "OpticsState.with_values": (models.OpticsState({"M2_dz": 10.0}).with_values, {"values": {"M2_rx": 1.0}}),
        "DegreesOfFreedom.apply": (m.dofs.apply, {"telescope": tel, "values": [1e-6]}),
        "DegreesOfFreedom.select": (m.dofs.select, {"names": ["M2.dz"]}),
        "SpotDiagram.radius_holding": (m.spots.radius_holding, {"fraction": 0.8}),
        "Coating": (models.Coating, {"wavelengths": (5e-7, 7e-7), "efficiencies": (0.9, 0.95)}),
        "Coating.at": (models.Coating((5e-7, 7e-7), (0.9, 0.95)).at, {"wavelength": [w]}),
        "Absorption": (design.Absorption, {"transmission": models.Coating((5e-7, 7e-7), (0.9, 0.95)),
                       "thickness": 0.01}),
        "Coatings": (design.Coatings, {"surfaces": {"M1": models.Coating((5e-7, 7e-7), (0.9, 0.95))}}),
        "CoatingTable": (models.CoatingTable, {"wavelengths": (5e-7, 7e-7), "angles": (0.0, 0.5),
                                               "efficiencies": ((0.9, 0.8), (0.95, 0.85))}),
        "CoatingTable.efficiency": (models.CoatingTable((5e-7, 7e-7), (0.0, 0.5), ((0.9, 0.8),) * 2).efficiency,
                                    {"wavelength": w, "cosine": [1.0], "n1": 1.0, "n2": 1.5}),
        "LayerStack": (models.LayerStack, {"indices": (1.38,), "thicknesses": (1e-7,)}),
        "LayerStack.efficiency": (models.LayerStack((1.38,), (1e-7,)).efficiency,
                                  {"wavelength": w, "cosine": [1.0], "n1": 1.0, "n2": 1.5}),
        "Coating.efficiency": (models.Coating((5e-7, 7e-7), (0.9, 0.95)).efficiency,
                               {"wavelength": w, "cosine": [1.0], "n1": 1.0, "n2": 1.5}),
        "Coatings.read": (design.Coatings.read, {"path": m.folder / "none.yaml"}),
        "Window": (pachon.Window, {"x": 0, "y": 0, "width": 10, "height": 10}),
        "Exposure": (pachon.Exposure, {"band": "r", "time": 15.0, "exposures": 1, "gain": 1.0, "sky": 21.0,
                     "pixel_scale": 1e-6, "read_noise": 8.8, "dark_current": 0.2, "full_well": 1e5,
                     "subtract_background": True, "noise": True}),
        "Exposure.electrons": (pachon.Exposure().electrons, {"magnitude": [20.0, 21.0]}),
        "PsfField.fit": (imaging.PsfField.fit, {"stamps": m.stamps, "positions": 100 + 50 * m.places, "pixels": 200,
                         "lit_fraction": np.full(12, 0.9), "n_components": 2, "order": 1,
                         "interpolation": "polynomial"}),
        "ShearEstimator": (measure.ShearEstimator, {"psf_images": m.shear_psf, "pixel_scale": 1e-6, "noise": 0.1,
                           "sigma": 2.6e-6, "side": 40}),
        "ShearEstimator.moments": (m.estimator.moments, {"stamps": np.ones((2, 40, 40)), "offsets": np.zeros((2, 2)),
                                   "psf_index": [0, 0], "threads": 1}),
        "ShearEstimator.ellipticity_and_response": (m.estimator.ellipticity_and_response, {
            "moments": np.ones((2, 6)), "psf_index": [0, 0], "seed": 1, "key": "noise", "min_snr": 5.0,
            "snr_width": 4.0}),
        "Annulus": (models.Annulus, {"inner": 1.0, "outer": 2.0, "x": 0.0, "y": 0.0}),
        "Circle": (models.Circle, {"radius": 1.0, "x": 0.0, "y": 0.0}),
        "Circle.contains": (models.Circle(1.0).contains, xy),
        "Ellipse": (models.Ellipse, {"semi_x": 1.0, "semi_y": 2.0, "x": 0.0, "y": 0.0, "angle": 0.0}),
        "Rectangle": (models.Rectangle, {"width": 1.0, "height": 2.0, "x": 0.0, "y": 0.0, "angle": 0.0}),
        "Vane": (models.Vane, {"width": 1.0, "x": 0.0, "y": 0.0, "angle": 0.0, "both_ways": True}),
        "Polygon": (models.Polygon, {"corners": ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))}),
        "Polygon.contains": (models.Polygon(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))).contains, xy),
        "Union": (models.Union, {"parts": (models.Circle(1.0), models.Circle(2.0))}),
        "Complement": (models.Complement, {"part": models.Circle(1.0)}),
        "Camera.ccd_at": (m.camera.ccd_at, {"x": [0.0, 0.1], "y": [0.0, 0.1], "margin": 0.0}),
        "Camera.turned": (m.camera.turned, {"angle_deg": 30.0}),
        "Camera.ccd_index": (m.camera.ccd_index, {"name": "R22_S11"}),
        "FocalPlane.from_budget": (pachon.FocalPlane.from_budget, {"camera": "lsst", "seed": 1, "terms": ["raft"],
                                   "budget": "simulated"}),
        "FocalPlane.flat": (pachon.FocalPlane.flat, {"camera": "lsst"}),
        "FocalPlane.as_measured": (pachon.FocalPlane.as_measured, {"name": "lsstcam"}),
        "FocalPlane.from_file": (pachon.FocalPlane.from_file, {"path": m.folder / "none.fits"}),
        "FocalPlane.from_heights": (pachon.FocalPlane.from_heights, {"table": {"x": [0.0], "y": [0.0], "z": [0.0]}}),
        "FocalPlane.from_mesh": (pachon.FocalPlane.from_mesh, {"mesh": m.cube}),
        "FocalPlane.with_moved": (m.plane.with_moved, {"name": "R22", "dz": 1e-6, "rx": 0.0, "ry": 0.0}),
        "FocalPlane.scaled": (m.plane.scaled, {"factors": 2.0}),
        "FocalPlane.height": (m.plane.height, {"x": [0.0, 0.1], "y": [0.0, 0.1]}),
        "FocalPlane.to_mesh": (m.plane.to_mesh, {"cells_per_ccd": 2}),
        "HeightBudget": (models.HeightBudget, {"global_height": 1e-6, "raft_height": 1e-6, "ccd_height": 1e-6,
                         "ccd_tilt": 1e-6, "potato_chip": 1e-6}),
        "Silicon": (models.Silicon, {"thickness": 1e-4, "temperature": 173.0}),
        "Silicon.absorption_length": (m.silicon.absorption_length, {"wavelength": w}),
        "GlassCatalogue.read": (models.GlassCatalogue.read, {"path": m.folder / "none.agf"}),
        "GlassCatalogue.parse": (models.GlassCatalogue.parse, {"text": "NM A 1 0\nCD 2.25\n", "source": "mine"}),
        "GlassCatalogue.of_maker": (models.GlassCatalogue.of_maker, {"maker": "ohara"}),
        "Air": (pachon.Air, {"pressure": 101325.0, "temperature": 288.0, "water_vapour": 0.0, "co2_ppm": 450.0,
                "formula": "ciddor"}),
        "Air.index": (pachon.Air().index, {"wavelength": [w]}),
        "Dispersion": (models.Dispersion, {"formula": "schott", "coefficients": (2.2, -0.01, 0.01, 0.0002, 0.0, 0.0),
                       "wavelength_range": (3e-7, 2e-6)}),
        "ConstantIndex": (pachon.ConstantIndex, {"n": 1.5}),
        "ConstantIndex.index": (pachon.ConstantIndex(1.5).index, {"wavelength": [w]}),
        "Sellmeier": (pachon.Sellmeier, {"B": (1.0, 0.2, 1.0), "C": (0.006, 0.02, 100.0)}),
        "TabulatedIndex": (models.TabulatedIndex, {"wavelengths": (4e-7, 5e-7, 6e-7), "indices": (1.5, 1.49, 1.48),
                           "interpolation": "monotone"}),
        "ChangedIndex": (models.ChangedIndex, {"medium": pachon.ConstantIndex(1.5), "change": 1e-5}),
        "Obstruction": (models.Obstruction, {"name": "o", "triangles": np.eye(3)[None], "before": ("M2",)}),
        "Obstruction.from_mesh": (models.Obstruction.from_mesh, {"name": "o", "mesh": m.cube, "scale": 1.0}),
        "Obstruction.from_file": (models.Obstruction.from_file, {"path": m.folder / "none.stl", "scale": 1.0}),
        "Biconic": (models.Biconic, {"radius_x": 5.0, "radius_y": 6.0, "conic_x": 0.0, "conic_y": 0.0}),
        "OddAsphere": (models.OddAsphere, {"radius": 5.0, "conic": 0.0, "coefficients": (0.0, 1e-6)}),
        "Toroid": (models.Toroid, {"radius_x": 5.0, "radius_y": 6.0, "conic_y": 0.0}),
        "XYPolynomial": (models.XYPolynomial, {"terms": ((1, 0, 1e-6),)}),
        "ZernikeSag": (models.ZernikeSag, {"coefficients": (0.0, 1e-6), "outer_radius": 4.0, "inner_radius": 0.5}),
        "GridSag": (models.GridSag, {"x": np.arange(5.0), "y": np.arange(5.0), "values": np.zeros((5, 5))}),
        "MeshSurface": (models.MeshSurface, {"vertices": np.eye(3), "faces": np.array([[0, 1, 2]]), "smooth": False}),
        "MeshSurface.from_file": (models.MeshSurface.from_file, {"path": m.folder / "none.stl", "scale": 1.0}),
        "QbfsAsphere": (
            models.QbfsAsphere,
            {"radius": 5.0, "conic": 0.0, "norm_radius": 1.0, "coefficients": (1e-3, 2e-4)},
        ),
        "ThinLens": (models.ThinLens, {"focal_length": 0.1, "object_distance": 0.3}),
        "Grating": (models.Grating, {"order": 1, "lines_per_mm": 1200.0, "groove_angle": 0.0}),
        "Conic": (pachon.Conic, {"radius": 5.0, "conic": 0.0}),
        "Conic.sag": (pachon.Conic(5.0).sag, xy),
        "Conic.gradient": (pachon.Conic(5.0).gradient, xy),
        "EvenAsphere": (models.EvenAsphere, {"radius": 5.0, "conic": 0.0, "coefficients": (1e-6,)}),
        "EvenAsphere.sag": (models.EvenAsphere(5.0, 0.0, (1e-6,)).sag, xy),
        "Sphere": (pachon.Sphere, {"radius": 5.0}),
        "Sum": (models.Sum, {"parts": (pachon.Conic(5.0), m.grid)}),
        "Weather": (models.Weather, {"pressure_mmhg": 520.0, "temperature_c": 10.0, "water_vapour_mmhg": 8.0}),
        "Site": (models.Site, {"name": "s", "altitudes": (0.0, 1e3), "weights": (0.5, 0.5), "wind_speeds": (5.0, 10.0),
                 "r0": 0.1, "outer_scale": 30.0, "weather": models.Weather(520.0, 10.0, 8.0)}),
        "Surface": (pachon.Surface, {"name": "s", "interaction": pachon.Interaction.REFRACT, "shape": pachon.Conic(5.0),
                    "vertex": (0.0, 0.0, 0.0), "medium_after": pachon.ConstantIndex(1.0),
                    "aperture": models.Circle(1.0), "semi_diameter": 1.0}),
        "DesignData": (models.DesignData, {"length_unit": "mm", "aperture": "f_number", "aperture_value": 4.0,
                       "stop": "M1", "aiming": "real", "field_type": "angle", "fields": ((0.0, 0.1),),
                       "field_weights": (1.0,), "vignetting": ((0.0, 0.0, 0.1, 0.1, 0.0),), "wavelengths": (w,),
                       "wavelength_weights": (1.0,), "temperature": 280.0, "pressure": 1e5, "telecentric": False,
                       "afocal": False, "remake_vignetting": False, "pickups": (models.Pickup("M2", "conic", "M1"),),
                       "solves": (models.Solve("M3", "marginal_height"),)}),
        "Pickup": (models.Pickup, {"surface": "M2", "quantity": "radius", "source": "M1", "scale": -1.0,
                   "offset": 0.1}),
        "Solve": (models.Solve, {"surface": "M2", "kind": "edge_thickness", "value": 1e-3, "radius": 0.1}),
        "Surface.to_local": (tel.surfaces[0].to_local, {"points": np.zeros((2, 3))}),
        "Surface.moved": (tel.surfaces[0].moved, {"shift": (0.0, 0.0, 0.0), "about": (0.0, 0.0, 0.0)}),
        "Telescope.perturbed": (tel.perturbed, {"name": "M2", "shift": (0.0, 0.0, 0.0), "tilt": (0.0, 0.0, 0.0),
                                "about": (0.0, 0.0, 0.0)}),
        "Telescope.with_rotator": (tel.with_rotator, {"angle": 0.1}),
        "Telescope.with_shape": (tel.with_shape, {"name": "M2", "shape": pachon.Conic(5.0)}),
        "Telescope.with_deformation": (tel.with_deformation, {"name": "M2", "deformation": m.grid}),
        "Telescope.with_coatings": (tel.with_coatings, {"coatings": {}}),
        "Telescope.surface": (tel.surface, {"name": "M2"}),
        "Telescope.check_wavelength": (tel.check_wavelength, {"wavelength": w}),
        "Telescope.check_field": (tel.check_field, {"tx": [0.0], "ty": [0.0]}),
        "FocalPlanePsf.fit": (pachon.FocalPlanePsf.fit, {"stars": m.stars, "camera": "lsst", "threads": 1,
                              "telescope": reconstruction.Instrument.of(tel, [w], stamps=pachon.Stamps(jitter=1e-7))}),
        "Instrument.of": (reconstruction.Instrument.of, {"telescope": tel, "wavelengths": pachon.Light([w], [1.0]),
                          "camera": "lsst", "weight_fwhm": 3.4e-6}),
        "OpticsPrior": (reconstruction.OpticsPrior, {"budget": "simulated", "alignment_rms": 1e-7}),
        "Stamps.of_camera": (pachon.Stamps.of_camera, {"camera": "lsst", "size": 31, "jitter": 0.0}),
        "FocalPlaneStars.from_table": (pachon.FocalPlaneStars.from_table, {"table": m.table, "weight_fwhm": 3.4e-6}),
        "Correlation.within": (m.correlation.within, {"separations": "short"}),
        "LevenbergMarquardt": (measure.LevenbergMarquardt, {"max_evaluations": 20, "tolerance": 1e-4}),
        "Recipe": (reconstruction.Recipe, {"basis": reconstruction.Pixels(),
                   "interpolation": reconstruction.Polynomial(1), "weights": "equal"}),
        "PrincipalComponents": (reconstruction.PrincipalComponents, {"n_components": 4}),
        "Pixels": (reconstruction.Pixels, {"n_components": None}),
        "Shapelets": (reconstruction.Shapelets, {"n_components": 4, "scale": 2.0}),
        "Kriging": (reconstruction.Kriging, {"order": 1}),
        "Polynomial": (reconstruction.Polynomial, {"order": 1}),
        "PsfModel.fit": (pachon.PsfModel.fit, {"stamps": m.stamps, "positions": m.places, "recipe": "paper",
                         "basis": "pca",
                         "interpolation": "polynomial", "weights": np.ones(12), "n_components": 2, "order": 1,
                         "masks": np.zeros((12, 15, 15), bool), "extent": (-1.0, 1.0, -1.0, 1.0),
                         "clipping": reconstruction.SigmaClipping(3.0)}),
        "SigmaClipping": (reconstruction.SigmaClipping, {"sigma": 3.0, "max_iterations": 5, "replacement": "mean"}),
        "PsfModel.fit kriging": (pachon.PsfModel.fit, {"stamps": 1e4 * m.stamps, "positions": m.places,
                                 "basis": "pixels", "interpolation": "kriging", "order": 1, "gain": 1.0}),
        "PsfModel.fit colour": (pachon.PsfModel.fit, {"stamps": m.stamps, "positions": m.places, "recipe": "paper",
                                "n_components": 2, "order": 1, "colour": np.linspace(0.0, 2.0, 12)}),
        "ColourTerm": (reconstruction.ColourTerm, {"order": 1}),
        "PsfModel.at": (m.model.at, {"positions": m.places[:2], "colour": [0.1, 0.2]}),
        "PsfModel.draw": (m.model.draw, {"x": 0.0, "y": 0.0, "colour": 0.5}),
        "psf_of_spectrum": (reconstruction.psf_of_spectrum, {"model": m.coloured, "positions": m.places[:2],
                            "light": pachon.Light([600e-9, 640e-9]), "pixel_scale": 1e-6}),
        "PsfModel.truncated": (m.model.truncated, {"n_components": 1}),
        "PsfModel.read": (pachon.PsfModel.read, {"path": m.folder / "none.fits", "name": "PSF"}),
        "EdgeRolloff": (pipeline.EdgeRolloff, {"amplitude": 1e-6, "length": 1e-4, "half_size": 0.02}),
        "TreeRings": (pipeline.TreeRings, {"amplitude": 1e-7, "period": 1e-3, "center": (0.03, 0.03), "phase": 0.0}),
        "TreeRings.at": (pipeline.TreeRings(1e-7, 1e-3, (0.03, 0.03)).at, xy),
        "Rays": (pachon.Rays, {"position": np.zeros((2, 3)), "direction": np.full((2, 3), 0.577), "wavelength": w,
                 "path_length": np.zeros(2)}),
        "Galaxies.single": (sky.Galaxies.single, {"xi": [0.0], "eta": [0.0], "magnitude": [22.0], "radius": [1e-6],
                            "e1": 0.1, "e2": 0.0, "sersic": 1.0}),
        "Galaxies.sheared": (m.galaxies.sheared, {"g1": 0.01, "g2": 0.0, "positions": True}),
        "Galaxies.rotated": (m.galaxies.rotated, {"angle": 0.1, "positions": True}),
        "Galaxies.take": (m.galaxies.take, {"indices": [0, 1]}),
        "GalaxyStamps.from_mosaic": (sky.GalaxyStamps.from_mosaic, {"path": m.folder / "none.fits", "side": 5.0,
                                     "seed": 1}),
        "GalaxyPopulation": (pachon.GalaxyPopulation, {"faintest": 24.0, "seed": 1, "brightest": 20.0,
                             "density": 1.0}),
        "GalaxyPopulation.galaxies_in": (pachon.GalaxyPopulation(23.0, 1).galaxies_in, {"xi": (-1e-4, 1e-4),
                                         "eta": (-1e-4, 1e-4)}),
        "ResidualWavefront.draw": (wavefront.ResidualWavefront.draw, {"telescope": tel, "rms": 2e-7, "seed": 1,
                                   "epoch": 0, "terms": [4, 5, 6], "linear_fraction": 0.5}),
        "ResidualWavefront.opd": (m.aberration.opd, {**xy, "slopes": (0.0, 0.0)}),
        "Atmosphere.from_site": (pachon.Atmosphere.from_site, {"site": "cerro_pachon", "seed": 1, "r0": 0.1,
                                 "outer_scale": 30.0, "exposure": 0.5, "time_step": 0.5, "epoch": 0,
                                 "screens": pachon.ScreenSampling(1024, 560.0)}),
        "ScreenSampling": (pachon.ScreenSampling, {"screen_size": 1024, "screen_length": 560.0, "fine_size": 3072,
                           "fine_pixel": 0.014, "cutoff": 8.75, "fixed_modulus": False}),
        "Site.with_layers": (models.load_site("cerro_pachon").with_layers, {"altitudes": [0.0, 1e3],
                             "weights": [0.5, 0.5], "wind_speeds": [5.0, 10.0], "wind_directions": [0.0, 1.0]}),
        "Atmosphere.at_times": (m.air.at_times, {"times": [0.25, 0.75], "exposure": 1.0}),
        "Request.on": (pachon.Request.of(tel).on, {"focal_plane": m.plane}),
        "Request.of": (pachon.Request.of, {"telescope": tel, "fields": np.zeros((1, 2)), "wavelengths": [w],
                       "wavelength_weights": [1.0], "sampling": "gauss", "n_pupil": 3, "projection": "zemax",
                       "threads": 1, "one_wavelength": True}),
        "CcdImage.read": (imaging.CcdImage.read, {"path": m.folder / "none.fits"}),
    }  # fmt: skip
    return out
