"""`python -m sensor_clients` is `sensor-client`."""

import sys

from sensor_clients.cli import main

if __name__ == "__main__":
    sys.exit(main())
