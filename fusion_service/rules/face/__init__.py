"""The face of the rules: the registry of what stands in the folder, the checks at the border, the generated tables."""

from fusion_service.rules.face.gaussians import Fused, fuse, fuse_last

__all__ = ["Fused", "fuse", "fuse_last"]
