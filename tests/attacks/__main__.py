"""`python -m tests.attacks`: every attack against an open and a secured bus, and every allowed use, as a table."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path

from tests.attacks.judging import Verdict, on_keys, on_links, with_own_hubs
from tests.attacks.lab import bad_certificates, keys, lab
from tests.attacks.onkeys import ON_KEYS
from tests.attacks.onlinks import at_own_hub, bare_link
from tests.attacks.uses import USES


def main() -> int:
    """Returns 0 if all attacks work in the open and none secured, each refused for a reason that is seen."""
    logging.basicConfig(level=logging.ERROR)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = keys(folder / "keys")
        bad = bad_certificates(folder / "bad", made)
        with lab(folder, None) as one:
            used_openly = {name: use(one) for name, use in USES.items()}
            opened = {verdict.name: verdict.worked for verdict in on_keys(one, ON_KEYS, 8.0)}
            opened[""] = bare_link(one, None).worked and at_own_hub(None, None).worked
        with lab(folder, made) as one:
            secured = on_keys(one, ON_KEYS, 3.0) + on_links(one, bad)
            used = {name: use(one) for name, use in USES.items()}  # while those who attack are still there
        secured += with_own_hubs(made, bad)
    print(f"{'attack':<38} open    secured  why")
    for verdict in secured:
        print(_row(verdict, opened.get(verdict.name, opened[""])))
    print(f"\n{'allowed use':<38} open    secured")
    for name in used:
        print(f"{name:<38} {_word(used_openly[name])} {_word(used[name])}")
    worked = [opened.get(verdict.name, opened[""]) for verdict in secured]
    refused = [verdict for verdict in secured if not verdict.worked]
    silent = [verdict.name for verdict in secured if verdict.missing]
    print(f"\n{sum(worked)} of {len(worked)} attacks work in the open, {len(refused)} are refused secured")
    print(
        f"{sum(used.values())} of {len(used)} allowed uses work secured; refused without a reason: {silent or 'none'}"
    )
    return 0 if all(worked) and len(refused) == len(secured) and all(used.values()) and not silent else 1


def _row(verdict: Verdict, opened: bool) -> str:
    why = (verdict.client.rpartition("; ")[2] or verdict.hub.partition("Hint")[0])[-110:]
    return f"{verdict.name:<38} {_word(opened)} {_word(verdict.worked)}  {why}"


def _word(worked: bool) -> str:
    return f"{'works' if worked else 'refused':<7}"


if __name__ == "__main__":
    raise SystemExit(main())
