from collections.abc import Iterator

import pytest
from processes import Hub


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub().start()
    yield hub
    hub.kill()
