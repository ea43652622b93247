import numpy as np
import pytest

from pachon.core.units import ARCSEC
from pachon.imaging.config import GalaxySourceConfig
from pachon.pipeline.run_folder import CONFIG_NAME
from pachon.sky.catalogue import write_galaxies
from pachon.sky.galaxies import Galaxies
from pachon.studies.visits.config import VisitsConfig, VisitsSection, load_visits_configuration
from pachon.studies.visits.image_stack.config import ImageStackConfig
from pachon.studies.visits.image_stack.stack_images import stack_images
from pachon.studies.visits.stack import PsfStack
from pachon.studies.visits.visits import stack_path, stack_visits


@pytest.fixture(scope="session")
def round_galaxies(tmp_path_factory):
    """Galaxies of a catalogue: 40 round ones on the tile."""
    path = tmp_path_factory.mktemp("catalogue") / "round.ecsv"
    places = np.random.default_rng(8).uniform(-90.0, 90.0, (2, 40)) * ARCSEC
    write_galaxies(path, Galaxies.single(*places, np.full(40, 21.0), np.full(40, 0.4 * ARCSEC)))
    return GalaxySourceConfig(catalogue=str(path))


@pytest.fixture(scope="package")
def small_visits(tiny):
    """Configuration of visits of one CCD with 450 stars, in the mean over all turbulence."""
    run = tiny(ccds=("R22_S11",), psf__engine="long_exposure", psf__n_pupil=200, psf__stamp=49)
    return VisitsConfig(run=run, visits=VisitsSection(count=2, stars=450, places=60, snapshots=(1,)))


@pytest.fixture
def visits_folder(small_visits, tmp_path):
    """Folder with the configuration of visits alone, which is all that images need."""
    experiment = small_visits.experiment()
    (tmp_path / CONFIG_NAME).write_text(small_visits.resolved(experiment).to_yaml())
    return tmp_path


@pytest.fixture(scope="package")
def visit_products(small_visits, tmp_path_factory, undrawn):
    """Folder of two visits, with the stacks of their PSFs."""
    folder = tmp_path_factory.mktemp("visits")
    with undrawn():
        stack_visits(small_visits, folder)
    return folder


@pytest.fixture(scope="package")
def noise_free(visit_products, round_galaxies, tmp_path_factory, undrawn):
    """Stack of two visits without noise, with round galaxies, beside that of the PSFs."""
    folder = tmp_path_factory.mktemp("noise_free")
    config = load_visits_configuration(visit_products / CONFIG_NAME)
    (folder / CONFIG_NAME).write_text(config.model_copy(update={"galaxies": round_galaxies}).to_yaml())
    psfs = {visits: PsfStack.read(stack_path(visit_products, visits)) for visits in (1, 2)}
    with undrawn():
        return stack_images(folder, ImageStackConfig(faintest=25.0, side=1024, noise=False)), psfs
