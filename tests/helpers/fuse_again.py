"""Fuse a recorded mission again by its step logs, with nothing but the public face of the centre."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import schemas
from fusion_service.centre import FusionCentre, SourceFound, SourceLost, order_of
from fusion_service.config import CentreConfig
from schemas import GlobalTracks, LocalIntensity, LocalTracks, Message, SensorInfo, StepLog

LATER = 2**62


def again(config: CentreConfig, messages: Iterable[Message]) -> list[tuple[GlobalTracks, GlobalTracks]]:
    """(recorded, made again) of every step that has a log."""
    inputs: dict[int, list[Any]] = defaultdict(list)
    logs: list[StepLog] = []
    pictures: dict[tuple[int, int], GlobalTracks] = {}
    for message in messages:
        if isinstance(message, (LocalTracks, LocalIntensity, SensorInfo)):
            inputs[schemas.digest(message)].append(message)
        elif isinstance(message, StepLog):
            logs.append(message)
        elif isinstance(message, GlobalTracks):
            pictures[message.epoch, message.step] = message
    pairs = []
    centre: FusionCentre | None = None
    for log in sorted(logs, key=lambda log: (log.epoch, log.step)):
        for event in log.events:
            if event["kind"] == "start":
                centre = FusionCentre(
                    config, event.get("checkpoint"), generation=event.get("generation"), epoch=event["epoch"]
                )
        assert centre is not None
        for event in log.events:
            if event["kind"] in ("found", "lost"):
                centre.handle((SourceFound if event["kind"] == "found" else SourceLost)(event["source"]), LATER)
            elif (order := order_of(event)) is not None:
                centre.handle(order, LATER)
        for entry in log.taken:
            centre.handle(inputs[entry.hash][0], LATER)
        made = centre.step(log.time).tracks
        pairs.append((pictures[log.epoch, log.step], made))
    return pairs


def differing(pairs: Iterable[tuple[GlobalTracks, GlobalTracks]]) -> list[int]:
    """Steps whose bytes differ in anything but when they were sent."""
    return [
        recorded.step
        for recorded, made in pairs
        if schemas.encode(dataclasses.replace(recorded, sent=0)) != schemas.encode(dataclasses.replace(made, sent=0))
    ]
