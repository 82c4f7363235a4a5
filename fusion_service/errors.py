"""The tree of errors: all that whoever calls or types can mend, each told in one line, with what a command returns.

FusionError                           1  the root; in `schemas.errors`, for `schemas` imports nothing of ours
  Stopped                             0  a signal came; the command says what was done until then
  UsageError                          2  a command, or its options, as it was typed
  ConfigError             ValueError  2  fusion_service.config: every problem of a config, with file, line and key
    ProfileError                      2  fusion_service.review.profiles: every problem of a profile, likewise
  MessageError            ValueError  1  schemas: a message that cannot be read or written
  BusError                            1  fusion_service.bus: an endpoint, a key, a hub that is not there
    BusStopped            Stopped     0  fusion_service.bus: stopped while it waited for the hub
  SecurityError                       2  fusion_service.bus: a security file, certificate or key that is no good
  StateError                          1  fusion_service.service.state: the folder of ids and checkpoint
  CheckpointError         ValueError  1  fusion_service.centre.checkpoint: a checkpoint that cannot be gone on from
  DemoError                           1  fusion_service.demo: a mission that cannot be flown, or went wrong
  HealthError                         1  what was looked at is not well, or does not answer: `status`, `listen`, `check`
  OrderError                          1  an order that a centre refuses, or that no centre hears
  ReviewError             ValueError  1  a recording, or what was asked of it
    NothingToScoreError               1  fusion_service.review.evaluation: nothing in it can be scored
  DataError               ValueError  1  recorded data of a sensor: a file that is not as it must be
  FrameError              ValueError  1  fusion_service.geodesy: a state that cannot be moved between two frames
  DensityError            ValueError  1  fusion_service.densities: what is no mixture, or cannot be reduced
  RuleError               ValueError  1  fusion_service.rules: a fusion that cannot be done
  ExistenceError          ValueError  1  fusion_service.existence: what is no probability, rate or weight
  MissingDataError        ValueError  1  studies: a study of real data that has not been told where they are
  OwnRuleError                        1  studies: a rule of the user's own that fails

The second column says what else it is; the number is the exit code. A command catches the
root once (`fusion_service.process.exit_code`). A function of a border raises ValueError for what a caller gives it;
it is made one of these where a person can mend it.
"""

from __future__ import annotations

from typing import ClassVar

from schemas.errors import FusionError, MessageError

__all__ = [
    "DataError",
    "FusionError",
    "HealthError",
    "MessageError",
    "OrderError",
    "ReviewError",
    "Stopped",
    "UsageError",
]


class Stopped(FusionError):
    """A signal came, and the work was left as it is. It is what was asked for: the exit code is 0."""

    exit_code: ClassVar[int] = 0


class UsageError(FusionError):
    """A command cannot be carried out as it was typed; the message says how to mend it."""

    exit_code: ClassVar[int] = 2


class HealthError(FusionError):
    """What was looked at is not well; the message says how many things are wrong, and one of them."""


class OrderError(FusionError):
    """An order that a centre does not obey; the message says why, in one line."""


class ReviewError(FusionError, ValueError):
    """A recording, or what was asked of it, is not as it must be; the message says how to mend it, in one line."""


class DataError(FusionError, ValueError):
    """Recorded data of a sensor are not as they must be; the message says which file, and what is wrong with it."""
