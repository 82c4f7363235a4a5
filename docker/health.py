#!/usr/bin/env python
"""Whether a fusion centre is at work: `centre-health [ENDPOINT [CENTRE [REALM [SECURITY]]]]`.

Exit code 0 once a status of the centre has come over the bus, as it does every second; else 1 and one line.
"""

import sys
import threading

from fusion_service.bus import DEFAULT_ENDPOINT, BusError, SecurityError, open_bus, read_security
from schemas import global_key

PATIENCE = 3.0


def main(endpoint: str = DEFAULT_ENDPOINT, centre: str = "centre", realm: str = "fusion", security: str = "") -> int:
    """Wait up to `PATIENCE` seconds for the hub at `endpoint`, and as long for a status of `centre`, as a viewer."""
    status = threading.Event()
    try:
        shown = read_security(security) if security else None
        with open_bus([endpoint], wait=PATIENCE, security=shown) as bus:
            bus.subscribe(global_key(centre, "status", realm), lambda key, data: status.set(), history=0)
            if status.wait(PATIENCE):
                return 0
        print(f"no status of {centre} within {PATIENCE:g} s")
    except (BusError, SecurityError) as error:
        print(error)
    return 1


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
