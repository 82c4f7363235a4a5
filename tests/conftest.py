import os
from collections.abc import Iterator

import pytest

from fusion_service.compiled.road import VARIABLE
from tests.helpers.processes import Hub

# The road of small matrices changes no bit: processes start on the plain one, which needs no compiler.
os.environ.setdefault(VARIABLE, "off")


@pytest.fixture(scope="session")
def one_hub() -> Iterator[Hub]:
    hub = Hub()
    yield hub
    hub.kill()


@pytest.fixture
def hub(one_hub: Hub) -> Hub:
    """A hub that runs. A test may kill it: the next one finds it started again."""
    return one_hub.start()
