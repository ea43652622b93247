import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine
from public_calls import calls


@pytest.fixture(scope="module", autouse=True)
def layout(coarse_pictures):
    """Pictures have a layout: examples of the pages, and results of every kind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", coarse_pictures)
        yield


@pytest.fixture(scope="session")
def table(tmp_path_factory):
    """Valid calls of public functions: callable and keyword arguments by label."""
    return calls(tmp_path_factory.mktemp("calls"))
