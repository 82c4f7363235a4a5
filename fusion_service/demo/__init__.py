"""A whole mission as processes: hub, service, recorder and clients; then a table, a map and a recording.

Nothing here is a special road: the processes are those of the commands, on a free port of loopback, and the
scores are computed from the recording.
"""

from fusion_service.demo.crew import Crew, DemoError, client_arguments, free_endpoint, record_arguments
from fusion_service.demo.missions import AUTOFERRY, MRCLAM, THREE_RADARS, MissionPlan, plan_mission
from fusion_service.demo.run import START, run_demo, write_config

__all__ = [
    "AUTOFERRY",
    "MRCLAM",
    "START",
    "THREE_RADARS",
    "Crew",
    "DemoError",
    "MissionPlan",
    "client_arguments",
    "free_endpoint",
    "plan_mission",
    "record_arguments",
    "run_demo",
    "write_config",
]
