"""Every fusion rule on real lidar and radar returns: the Autoferry recordings, scored against satellite positions.

Five scenarios of about two minutes with two vessels each; the local trackers are those of `sensor-client playback
autoferry:N`, the centre that of `fusion-service demo --scenario autoferry:N` (step 1 s, motion of a global track
q = 0.1 m2/s3). Sensors are tracked once, then every rule and memory fuses the same local tracks. Scores are those of
`fusion-service evaluate`, every second with c = 20 m: GOSPA in m and the squares it is made of, RMSE and ANEES (over
its dimension, 2) of the pairs it assigns, identity switches; the mean over the scenarios, and GOSPA of each. restart:
local tracks only, fused anew at every step; recursive: their result is fused with the predicted last one, by CI with
weights by det whatever the rule is. tracklet: what successive versions of a local track have added goes as
measurements into a filter of the target's own, and the rule matters only where that is not sound, so it is run for CI
alone; with the demo's motion, and ("said") with that which the trackers declare.

No chance is in it, so the numbers have no error. "beside ci" is the mean difference of GOSPA to `ci restart` on the
same scenes; its error is that of the mean as if the five scenes were drawn from many like them (jackknife, one scene
left out at a time). With five scenes a difference is significant (5 %) beyond 2.8 of its errors, and of thirty that
mean nothing one or two will look so.

Read it with care: the local trackers were tuned on these same five scenarios under `ci`, and there are no others to
test on. Lidar and radar share the own ship's navigation, so their errors are correlated to an unknown degree. The
sampled rules (`hmd-s`, `gmd-s`) draw from a fixed seed. `bar-shalom-campo` needs a cross-covariance, which no sensor
states, and is left out. Fewer than five runs take the first scenarios only, and few rules.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.demo import AUTOFERRY
from fusion_service.review.evaluation import METRICS, Scores, evaluate
from schemas import Truth
from sensor_clients.playback.autoferry import load
from studies import missions
from studies.pictures import colour
from studies.rules import Fuser, fuser
from studies.statistics import Estimate, jackknife
from studies.study import Floats, MissingDataError, Result, Row, Run, Study

SCENARIOS = (2, 3, 5, 13, 16)
SENSORS = ("lidar", "radar")
RULES = (
    *("naive", "ci", "ci:criterion=trace"),
    *(f"bci:max_correlation={bound}" for bound in (0.25, 0.5, 0.75)),
    *("fast-ci", "ffcc", "ici", "ei", "hmd-ga", "hmd-s", "gmd-s", "aa", "cu"),
)
FEW = ("ci", "hmd-ga")
CRITICAL = 2.776
"""Student's t of 5 % on both sides, four degrees of freedom."""
QUANTITIES = ("GOSPA, m", "localisation, m2", "missed, m2", "false, m2", "RMSE, m", "ANEES", "identity switches")
BESIDE = "beside ci, m"
MEMORIES = ("restart", "recursive")
TRACKLETS = ("tracklet", "tracklet said")
CI = 2
"""Row of `ci restart`, below those of lidar and radar."""
Way = tuple[Fuser, str]


@lru_cache(maxsize=1)
def heard(folder: Path, number: int) -> tuple[list[missions.Told], list[Truth]]:
    """What lidar and radar say in a scenario, and its truth."""
    scenario = load(folder, number)
    return missions.told(scenario, 0, SENSORS), missions.truths(scenario)


def scored(folder: Path, number: int, settings: Mapping[str, Any]) -> dict[str, Scores]:
    """Scores of lidar, radar and "fused" by a centre of these settings above the demo's."""
    told, truth = heard(folder, number)
    pictures = missions.fuse(told, {**tomllib.loads(AUTOFERRY), **settings})
    result = evaluate([*told, *truth, *pictures], c=20.0, every=1.0)
    return {**result.sources, "fused": result.fused}


def fly(item: tuple[int, Way], folder: Path) -> Floats:
    """The METRICS (3, 7) of lidar, radar and fused in a scenario."""
    number, (rule, memory) = item
    settings: dict[str, Any] = {
        "rule": rule.rule,
        "rule_options": dict(rule.options),
        "memory": memory.partition(" ")[0],
    }
    if memory == "tracklet said":
        settings["motion"] = None
    scores = scored(folder, number, settings)
    return np.array([[getattr(scores[name], metric) for metric in METRICS] for name in (*SENSORS, "fused")])


def run(run: Run) -> Result:
    numbers = SCENARIOS[: run.runs]
    folder = recordings(run.data, numbers)
    own = [rule.label for rule in run.rules if not in_centre(rule)]
    rules = [fuser(text) for text in (RULES if len(numbers) == len(SCENARIOS) else FEW)]
    rules += [rule for rule in run.rules if in_centre(rule)]
    ways = [(rule, memory) for memory in MEMORIES for rule in sorted(rules, key=lambda rule: rule.label != "ci")]
    ways += [(fuser("ci"), memory) for memory in TRACKLETS]
    items = [(number, way) for number in numbers for way in ways]
    found = np.array(run.map(partial(fly, folder=folder), items, "scenarios")).reshape(len(numbers), len(ways), 3, -1)
    # (2 + W, 7, L): lidar, radar, each way; METRICS; scenarios
    scores = np.concatenate([found[:, 0, :2], found[:, :, 2]], axis=1).transpose(1, 2, 0)
    labels = [*SENSORS, *(f"{rule.label} {memory}" for rule, memory in ways)]
    rows = []
    for label, score in zip(labels, scores, strict=True):
        rows += [Row(label, name, None, float(one.mean())) for name, one in zip(QUANTITIES, score, strict=True)]
        rows.insert(-len(QUANTITIES) + 1, Row(label, BESIDE, None, *over(score[0] - scores[CI, 0])))
        rows += [Row(label, f"GOSPA {number}", None, float(one)) for number, one in zip(numbers, score[0], strict=True)]
    gospa = dict(zip(labels, scores[:, 0], strict=True))
    notes = list(compared(gospa)) if len(numbers) == len(SCENARIOS) else []
    notes += [f"{label} is left out: only a rule with options can be a setting of the centre." for label in own]
    return Result(tuple(rows), tuple(notes), partial(draw, gospa=gospa, numbers=numbers), (11.0, 6.5))


def recordings(folder: Path | None, numbers: tuple[int, ...]) -> Path:
    """The folder, if it has these scenarios. MissingDataError."""
    how = "name their folder with --data DIR or in FUSION_DATA"
    if folder is None:
        raise MissingDataError(f"needs the Autoferry recordings: {how}")
    for number in numbers:
        for kind in ("detections", "groundTruth"):
            if not (folder / f"scenario{number}_{kind}.json").is_file():
                raise MissingDataError(
                    f"no scenario{number}_{kind}.json of the Autoferry recordings in {folder}: {how}"
                )
    return folder


def in_centre(rule: Fuser) -> bool:
    """Whether a config can say it."""
    return rule.weights is None


def over(values: Floats) -> Estimate:
    """Mean over the scenarios (L,), and its error."""
    return jackknife(lambda some: float(some.mean()), values) if len(values) > 1 else Estimate(float(values[0]), 0.0)


def compared(gospa: Mapping[str, Floats]) -> Iterator[str]:
    """What the differences say; gospa: label -> (L,)."""

    def told(label: str, other: str) -> tuple[str, float]:
        value, error = over(gospa[label] - gospa[other])
        return f"{label} ({value:+.3f} ± {error:.3f})", value / error if error else 0.0

    fused = {
        label: float(np.mean(value - gospa["ci restart"])) for label, value in gospa.items() if label not in SENSORS
    }
    low, high = min(fused, key=lambda label: fused[label]), max(fused, key=lambda label: fused[label])
    yield (
        f"All rules lie between {fused[low]:+.3f} m ({low}) and {fused[high]:+.3f} m ({high}) of ci restart: little "
        f"beside the {np.ptp(gospa['ci restart']):.1f} m between scenes, and beside the 1 m by which the single "
        "sensors move when their tuning does (docs/measurements.md). A rule moves the localisation; which targets are "
        "missed and which tracks are false is decided by the local trackers and the association."
    )
    better: list[str] = []
    worse: list[str] = []
    alike: list[str] = []
    for label in gospa:
        if label not in (*SENSORS, "ci restart"):
            words, t = told(label, "ci restart")
            (alike if abs(t) < CRITICAL else better if t < 0 else worse).append(words)
    yield f"Significantly better than ci restart, GOSPA in m: {', '.join(better) or 'none'}."
    yield f"Significantly worse: {', '.join(worse) or 'none'}."
    yield f"Not to be told from it: {', '.join(alike) or 'none'}."
    told_ = [told(f"ci {memory}", "ci restart")[0] for memory in TRACKLETS]
    yield f"Tracklets beside ci restart, GOSPA in m: {', '.join(told_)}."
    pairs = [label.removesuffix(" restart") for label in gospa if label.endswith(" restart")]
    changes = [told(f"{rule} recursive", f"{rule} restart") for rule in pairs]
    sure = [words for words, t in changes if abs(t) >= CRITICAL]
    yield f"Recursive memory beside restart of the same rule is significant for: {', '.join(sure) or 'none'}."
    singles = [(name, *over(gospa["ci restart"] - gospa[name])) for name in SENSORS]
    words = " and ".join(f"{value:+.2f} ± {error:.2f} m beside the {name}" for name, value, error in singles)
    best = sum(gospa["ci restart"] < np.minimum(*(gospa[name] for name in SENSORS)))
    yield f"The GOSPA of ci restart is {words}; it is better than both in {best} of {len(SCENARIOS)} scenes."


def draw(figure: Any, gospa: Mapping[str, Floats], numbers: tuple[int, ...]) -> None:
    """Differences of GOSPA to ci restart, scene by scene."""
    panels = figure.subplots(1, len(MEMORIES), sharey=True, sharex=True)
    rules = [label.removesuffix(" restart") for label in gospa if label.endswith(" restart")]
    rows = [*rules, *(f"ci {memory}" for memory in TRACKLETS)]
    for axes, memory in zip(panels, MEMORIES, strict=True):
        axes.axvline(0.0, color="0.8", zorder=0)
        for y, rule in enumerate(rows):
            change = gospa[f"{rule} {memory}" if rule in rules else rule] - gospa["ci restart"]
            for number, one, marker in zip(numbers, change, "os^Dv", strict=False):
                name = f"scenario {number}" if not y else None
                axes.plot(one, y, marker, color=colour(rule), alpha=0.55, markersize=6, label=name, linestyle="none")
            axes.plot(
                change.mean(),
                y,
                "|",
                color="black",
                markersize=18,
                markeredgewidth=2.5,
                label="mean" if not y else None,
            )
        axes.set_xlabel("GOSPA less that of ci, restart, m")
        axes.set_title(f"memory: {memory}")
        axes.grid(axis="x", color="0.92")
    panels[0].set_yticks(range(len(rows)), rows)
    panels[0].invert_yaxis()
    legend = figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    for handle in legend.legend_handles[:-1]:
        handle.set_color("0.45")
    figure.suptitle("Autoferry: what a rule changes differs from scene to scene (left is better)")


STUDIES = (
    Study(
        name="autoferry",
        title="Every rule on real lidar and radar",
        source="ours, data of Helgesen et al. 2022",
        about=__doc__ or "",
        run=run,
        runs=len(SCENARIOS),
        quick=1,
        seconds=100.0,
        takes_rules=True,
        needs_data=True,
        widest=len(QUANTITIES) + 1 + len(SCENARIOS),
    ),
)
