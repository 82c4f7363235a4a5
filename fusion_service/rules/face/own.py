"""A rule of one's own: a function in a Python file, named `my_rule.py:fuse` in a config, `replay` and the studies.

    def fuse(means, covariances):            # (B, N, n), (B, N, n, n): B fusions of N >= 2 sources
        '''What it is.'''
        return mean, covariance              # (B, n), (B, n, n); weights (B, N) may be third

    fuse.promise = "what it promises"        # left out: none

Keyword arguments after `*` are its options. It is one file, run once when it is loaded, and known by its name and the
first digits of the SHA-256 of the file: `my_rule.py:fuse#0f3c...`. That is the rule's name in the settings of a centre,
their hash, step logs and pictures: what fused a mission can be told, and a replay finds out that a file is another.
What the file imports is not in the hash. A name loads nothing: only `load_own` does, which callers use for what their
own user wrote, in a config or on a command line, never for what a recording or the bus says.

What it gives is checked, every batch: shapes, finite numbers, symmetric positive definite covariances. `own_fuse`
raises RuleError for it; in a centre what is wrong becomes NaN, which the centre mends and logs, and each kind of fault
is said once in the process's log.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.rules.base.block import Result, Sources, alone
from fusion_service.rules.base.options import Option, RuleError
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.face.registry import RULES

__all__ = ["OwnRule", "is_own", "load_own", "loaded", "own_fuse", "told_name"]

log = logging.getLogger(__name__)

TEXT = re.compile(r"(?P<file>.+\.py):(?P<function>[^:#]*)(?::(?P<options>.*))?")
NAME = re.compile(r"[^/\\]+\.py:[A-Za-z_]\w*#[0-9a-f]{16}")
NO_PROMISE = "none is stated"
MOST_TOLD = 20
"""Kinds of faults of one rule that are said in the log."""
SKEW = 1e-9
"""Of the standard deviations: how far a covariance may be from symmetric."""


@dataclass(eq=False)
class OwnRule:
    """A loaded one. hash: SHA-256 of the file; told: faults that were said; problem: the last one, empty at first."""

    path: Path
    name: str
    hash: str
    function: Callable[..., Any]
    takes: Mapping[str, Option]
    promise: str
    doc: str
    told: set[str] = field(default_factory=set)
    problem: str = ""

    def __call__(self, sources: Sources, weights: Floats | None, influence: bool, **options: Any) -> Result:
        """As the registry calls a rule: what it cannot do is NaN."""
        if sources.count == 1:
            return alone(sources, influence)
        n, N, size = sources.means.shape
        nothing = np.full((n, size), np.nan), np.full((n, n, size), np.nan), np.full((N, size), np.nan)
        mean, covariance, share = nothing
        bad = np.ones(size, dtype=np.bool_)
        if sources.fast:  # what float64 cannot carry is not for it
            means, covariances = _first(sources.means), _first(sources.covariances)
            try:
                given = _given(self, means, covariances, options)
            except RuleError as error:
                self._note(str(error))
            else:
                bad = given.bad
                if bad.any():
                    self._note(given.why)
                mean, covariance, share = (np.moveaxis(part, 0, -1).copy() for part in given[:3])
                mean[:, bad], covariance[..., bad], share[:, bad] = np.nan, np.nan, np.nan
        doubt = np.where(bad, np.inf, 0.0)
        return Result(mean, covariance, share, share.copy() if influence else None, doubt, np.zeros(size))

    def _note(self, problem: str) -> None:
        """Say it, once for each kind: places and numbers make no new one."""
        self.problem = problem
        kind = re.sub(r"[\d.e+-]+", "#", problem)
        if kind not in self.told and len(self.told) < MOST_TOLD:
            self.told.add(kind)
            log.warning("%s: the centre fuses these tracks by equal-weight intersection", problem)


class Given(NamedTuple):
    """What a rule gave: mean (B, n), covariance (B, n, n), weights (B, N), NaN where it told none, all of them numbers;
    bad (B,): where it is no Gaussian, and why the first of these is none."""

    mean: Floats
    covariance: Floats
    weights: Floats
    bad: Bools
    why: str


def is_own(text: str) -> bool:
    """Whether a text names a rule by its file: `my_rule.py:fuse`, also with options or a hash behind it."""
    return TEXT.fullmatch(text.partition("#")[0]) is not None


def told_name(name: str) -> tuple[str, str] | None:
    """(`my_rule.py:fuse`, hash) of the name of a rule that was loaded, here or elsewhere; None for any other."""
    return (name[:-17], name[-16:]) if NAME.fullmatch(name) else None


def load_own(text: str, folder: Path = Path()) -> tuple[Rule, str]:
    """Load the rule that `text` names, its path below `folder`, and what stands behind a second colon (its options).

    Runs the file, unless this version of it was loaded before. Raises RuleError of one line, which says what is wrong.
    """
    found = TEXT.fullmatch(text)
    if found is None:
        raise RuleError(f"{text!r} names no rule: write FILE.py:FUNCTION, as in my_rule.py:fuse")
    path, function = folder / found["file"], found["function"]
    try:
        source = path.read_bytes()
    except OSError as error:
        raise RuleError(f"no file {path} to take a rule from ({error.strerror or error})") from None
    digest = hashlib.sha256(source).hexdigest()
    name = f"{path.name}:{function}#{digest[:16]}"
    if name not in RULES.own:
        module = _run(path, source, digest)
        RULES.own[name] = _rule(path, name, digest, module, function)
    return RULES.own[name], found["options"] or ""


def loaded(name: str) -> OwnRule | None:
    """The rule of one's own of this name, None for a shipped one or one that is not loaded."""
    rule = RULES.own.get(name)
    return rule.fuse if rule is not None and isinstance(rule.fuse, OwnRule) else None


def own_fuse(
    rule: OwnRule, means: Floats, covariances: Floats, options: Mapping[str, Any] | None = None
) -> tuple[Floats, Floats, Floats]:
    """Fuse means (B, N, n), covariances (B, N, n, n): mean (B, n), covariance (B, n, n), weights (B, N), NaN where it
    has none. Raises RuleError for a rule that fails, or gives what is no Gaussian: what, where, and what is wanted."""
    given = _given(rule, means, covariances, options or {})
    if given.bad.any():
        raise RuleError(given.why)
    return given.mean, given.covariance, given.weights


def _run(path: Path, source: bytes, digest: str) -> ModuleType:
    module = ModuleType(f"own_rule_{digest[:16]}", f"Rules of {path}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # a dataclass in it looks there
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        where = f" (line {line})" if (line := _line(error, path)) else ""
        raise RuleError(f"{path} cannot be run: {type(error).__name__}: {error}{where}") from None
    return module


def _line(error: BaseException, path: Path) -> int:
    """The last line of the file that an error went through, 0 if none."""
    if isinstance(error, SyntaxError):
        return 0  # it says it itself
    lines, trace = [], error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return lines[-1] if lines else 0


def _rule(path: Path, name: str, digest: str, module: ModuleType, function: str) -> Rule:
    found = getattr(module, function, None)
    if not callable(found):
        there = [
            key for key, value in vars(module).items()
            if inspect.isfunction(value) and value.__module__ == module.__name__ and not key.startswith("_")
        ]  # fmt: skip
        hint = f"it has {', '.join(there)}" if there else "it has none"
        raise RuleError(f"{path} has no function {function!r}: write {path}:FUNCTION ({hint})")
    promise = str(getattr(found, "promise", "") or NO_PROMISE)
    doc = inspect.getdoc(found) or ""
    own = OwnRule(path, name, digest, found, _options(path, function, found), promise, doc)
    return Rule(
        name=name,
        title=doc.split("\n")[0] or f"a rule of one's own, {path.name}:{function}",
        promise=promise,
        source=f"{path}, SHA-256 {digest}",
        takes=own.takes,
        fuse=own,
        takes_weights=False,
        refusal=f"cannot be fused by {path.name}:{function}: the log says why",
    )


def _options(path: Path, name: str, function: Callable[..., Any]) -> dict[str, Option]:
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return {}
    plain = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    many = any(one.kind == one.VAR_POSITIONAL for one in parameters)
    needed = [one for one in plain if one.default is one.empty]
    if not (many or len(plain) >= 2) or len(needed) > 2:
        raise RuleError(f"{path}:{name} takes ({', '.join(map(str, parameters))}): it must take (means, covariances)")
    options = [*plain[2:], *(one for one in parameters if one.kind == one.KEYWORD_ONLY)]
    if missing := [one.name for one in options if one.default is one.empty]:
        raise RuleError(f"{path}:{name} needs {missing[0]!r}: give that option a default")
    return {one.name: Option(one.default) for one in options}


def _first(a: Floats) -> Floats:
    """(..., N, B) with one or two axes of the state before -> (B, N, ...), a copy of its own."""
    return np.ascontiguousarray(np.moveaxis(a, (-1, -2), (0, 1)))


def _given(rule: OwnRule, means: Floats, covariances: Floats, options: Mapping[str, Any]) -> Given:
    """Call it and look at what it gives. RuleError where that has not the shapes it must have."""
    size, N, n = means.shape
    title = f"rule {rule.path}:{rule.function.__name__}"
    try:
        result = rule.function(means, covariances, **options)
        parts = _parts(result)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever it raises, SystemExit and its own kinds too, ends no centre
        where = f", line {line}" if (line := _line(error, rule.path)) else ""
        raise RuleError(f"{title}: {type(error).__name__}: {error}{where}") from None
    wanted: list[tuple[int, ...]] = [(size, n), (size, n, n), (size, N)]
    words = f"mean {wanted[0]} and covariance {wanted[1]}; weights {wanted[2]} may be third"
    legend = f"(B, n), (B, n, n), (B, N) of means {(size, N, n)}"
    if parts is None:
        got = type(result).__name__ + (f" of {len(result)}" if isinstance(result, (tuple, list)) else "")
        raise RuleError(f"{title}: gives {got}, not {words}: {legend}")
    try:
        arrays = [np.asarray(part, dtype=np.float64) for part in parts]
    except Exception as error:
        raise RuleError(f"{title}: gives no numbers ({error}), not {words}: {legend}") from None
    shapes = [one.shape for one in arrays]
    if shapes != wanted[: len(shapes)]:
        names = ", ".join(
            f"{name} {shape}" for name, shape in zip(("mean", "covariance", "weights"), shapes, strict=False)
        )
        raise RuleError(f"{title}: gives {names}, not {words}: {legend}")
    weights = arrays[2] if len(arrays) == 3 else np.full((size, N), np.nan)
    mean, covariance, bad, why = _judged(title, arrays[0], arrays[1])
    return Given(mean, covariance, weights, bad, why)


def _parts(result: Any) -> list[Any] | None:
    if isinstance(result, (tuple, list)):
        parts = list(result)
    elif hasattr(result, "mean") and hasattr(result, "covariance"):
        parts = [result.mean, result.covariance, *([result.weights] if hasattr(result, "weights") else [])]
    else:
        return None
    parts = parts[:2] if len(parts) == 3 and parts[2] is None else parts
    return parts if len(parts) in (2, 3) else None


def _judged(title: str, mean: Floats, covariance: Floats) -> tuple[Floats, Floats, Bools, str]:
    """Exactly symmetric, and where they are no Gaussians; why the first is none."""
    with np.errstate(all="ignore"):
        finite = np.isfinite(mean).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1))
        scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=-2, axis2=-1)))
        off = np.abs(covariance - np.swapaxes(covariance, -2, -1))
        level = (off <= SKEW * scale[..., :, None] * scale[..., None, :]).all(axis=(-2, -1))
        turned = np.swapaxes(covariance, -2, -1)
        symmetric = np.where(covariance == turned, covariance, 0.5 * (covariance + turned))
        definite = linalg.is_positive_definite(np.moveaxis(symmetric, 0, -1))
    faults = (("is not finite", ~finite), ("is not symmetric", ~level), ("is not positive definite", ~definite))
    bad: Bools = np.asarray(~(finite & level & definite))
    why = ""
    for words, where in faults:
        if np.any(where):
            at = int(np.flatnonzero(where)[0])
            what = "mean or covariance" if words == "is not finite" else "covariance"
            why = f"{title}: {what} [{at}] {words} ({int(np.sum(where))} of {len(mean)} in the batch)"
            break
    return mean, symmetric, bad, why
