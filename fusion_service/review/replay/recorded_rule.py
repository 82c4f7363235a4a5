"""A mission that was fused by a rule of one's own: made again only by the very file that its settings name.

The recording says the file's name and hash. Code is never looked for because a recording names it: whoever replays
gives it, with `--rule FILE.py:FUNCTION` or a config.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fusion_service.config.own_rule import is_loaded, told_rule
from fusion_service.errors import ReviewError
from fusion_service.recording.survey import RecordedCentre
from fusion_service.review.replay.variants import Variant

__all__ = ["missing_rule", "recorded_rules", "with_recorded_rule"]


def recorded_rules(followed: RecordedCentre) -> list[str]:
    """Names of the rules of one's own in the settings of all runs, each once."""
    named = [str(tables.get("rule", "")) for tables in followed.settings.values()]
    return list(dict.fromkeys(name for name in named if told_rule(name)))


def with_recorded_rule(
    variants: Sequence[Variant], followed: RecordedCentre, *, verify: bool
) -> tuple[list[Variant], list[str]]:
    """The variants, one by the file that the mission was fused by as the mission's own way, and what is to be said of
    files that are others. With `verify` ReviewError where there is such a one."""
    recorded, remarks, found = recorded_rules(followed), [], []
    for one in variants:
        given = told_rule(one.rule)
        if given is None:
            found.append(one)
            continue
        if one.rule in recorded and not one.options:
            found.append(replace(one, rule=""))
            continue
        other = [told for told in map(told_rule, recorded) if told is not None and told[0] == given[0]]
        if other and one.rule not in recorded:
            remarks.append(
                f"{given[0]} is another file now: the mission was fused by that with hash {other[0][1]}, this has "
                f"hash {given[1]}"
            )
        if verify:
            what = remarks[-1] if other and remarks else f"the mission was not fused by {given[0]}"
            raise ReviewError(f"{what}: nothing can be verified")
        found.append(one)
    return found, remarks


def missing_rule(name: str, replaced: bool) -> str:
    """Why settings with this rule cannot be used, empty where they can: it is not loaded, and not `replaced`."""
    told = told_rule(name)
    if told is None or is_loaded(name) or replaced:
        return ""
    file = told[0].partition(":")[0]
    return (
        f"was fused by a rule of one's own, {told[0]}, SHA-256 {told[1]}...: its code is not in the recording, and is "
        f"run only if you name the file, with --rule PATH/{file}:{told[0].partition(':')[2]} or a config that does"
    )
