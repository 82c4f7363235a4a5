"""The centre that a config asks for, from a checkpoint where that can be used."""

from __future__ import annotations

from fusion_service.centre.centre import Centre
from fusion_service.centre.checkpoint import CheckpointError
from fusion_service.centre.fusion import FusionCentre
from fusion_service.centre.intensity import IntensityCentre
from fusion_service.config import CentreConfig

__all__ = ["make_centre"]


def make_centre(
    config: CentreConfig, checkpoint: bytes | None = None, *, generation: int | None = None, epoch: int = 0
) -> tuple[Centre, str]:
    """A centre of the config's kind, and why it begins without the checkpoint (empty where it does not).
    Arguments as for `Centre`."""
    kind = IntensityCentre if config.kind == "intensity" else FusionCentre
    try:
        return kind(config, checkpoint, generation=generation, epoch=epoch), ""
    except CheckpointError as error:
        return kind(config, generation=generation, epoch=epoch), str(error)
