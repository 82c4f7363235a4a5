"""Recordings: the only folder that imports rerun, and only when something is recorded or read."""

from fusion_service.recording.parts import Rotation, parts
from fusion_service.recording.process import default_path, run_recorder
from fusion_service.recording.reader import RawMessage, messages, read, repair
from fusion_service.recording.recorder import Recorder

__all__ = ["RawMessage", "Recorder", "Rotation", "default_path", "messages", "parts", "read", "repair", "run_recorder"]
