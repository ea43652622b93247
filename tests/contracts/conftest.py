import pytest
from public_calls import calls


@pytest.fixture(scope="session")
def table(tmp_path_factory):
    """Valid calls of public functions: callable and keyword arguments by label."""
    return calls(tmp_path_factory.mktemp("calls"))
