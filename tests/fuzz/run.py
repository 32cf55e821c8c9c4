"""Fuzz every reader in this process: `python tests/fuzz/run.py --seconds 300`.

The n-th input of a seed is always the same. A traceback, a warning, a hang (over 5 s) or 2 GiB is a find: it is put
into --finds and the exit code is 1. `tests/test_fuzz.py` tries the finds in `tests/fuzz/finds` again.
"""

from __future__ import annotations

import argparse
import hashlib
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from random import Random

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from mutate import mutated  # noqa: E402
from targets import Target, targets  # noqa: E402

from thermofusion.errors import ThermofusionError, visible  # noqa: E402

HANG_S = 5.0  # of the processor
MAX_GROWTH_MB = 2048.0
LONGEST_SENTENCE = 3000  # characters: two paths of a thousand and a clause


class Hang(BaseException):
    """An input took too long."""


def main() -> int:
    """Try inputs until the time or the number is up; 1 if there was a find."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--inputs", type=int, default=10**9)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="one target")
    parser.add_argument("--finds", type=Path, default=HERE / "finds")
    parser.add_argument("--again", type=Path, help="try the finds of this folder, nothing else")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        chosen = [t for t in targets(Path(scratch)) if options.only in (None, t.name)]
        found = _loop(chosen, options) if options.again is None else _again(chosen, options.again)
    return 1 if found else 0


def _again(chosen: list[Target], folder: Path) -> int:
    found = 0
    for path in sorted(folder.iterdir()):
        name, *parts, _ = path.name.split("@")
        for target in (t for t in chosen if t.name == name):
            fault = attempt(target, "/".join(parts), path.read_bytes())
            if fault not in ("", "refused"):
                found += 1
                print(f"{path.name}:\n{fault}")
    return found


def _loop(chosen: list[Target], options: argparse.Namespace) -> int:
    weights = [t.weight for t in chosen]
    kinds, tried, refused, found = Counter[str](), Counter[str](), 0, 0
    end, slowest = time.monotonic() + options.seconds, (0.0, "")
    for number in range(options.first, options.first + options.inputs):
        if time.monotonic() > end:
            break
        random = Random(f"{options.seed}-{number}")
        (target,) = random.choices(chosen, weights)
        name = random.choice(list(target.seeds))
        data = mutated(name, target.seeds[name], list(target.seeds.values()), random)
        start = time.process_time()
        fault = attempt(target, name, data)
        slowest = max(slowest, (time.process_time() - start, f"{target.name} {name}"))
        tried[target.name] += 1
        refused += fault == "refused"
        if fault not in ("", "refused"):
            kinds[fault.splitlines()[-1][:60]] += 1
            found += 1
            if kinds[fault.splitlines()[-1][:60]] <= 2:
                print(f"find {number} ({target.name}, {name}):\n{fault}", flush=True)
                keep(options.finds, target, name, data)
    spread = ", ".join(f"{n} {c}" for n, c in tried.items())
    print(f"{sum(tried.values()):,} inputs ({spread}), {refused:,} refused, {found} finds; slowest {slowest[0]:.1f} s "
          f"({slowest[1]}), peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")  # fmt: skip
    return found


def attempt(target: Target, name: str, data: bytes) -> str:
    """`refused`, nothing where the input is read, or what is wrong about the program."""
    before = _peak_mb()
    signal.signal(signal.SIGVTALRM, _hang)
    signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
    outcome = ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            target.attempt(name, data)
    except ThermofusionError as e:
        text = e.sentence()
        good = visible(text) == text and len(text) < LONGEST_SENTENCE
        outcome = "refused" if good else f"a bad sentence: {text[:300]!r}"
    except Hang:
        outcome = traceback.format_exc() + f"\nhang: more than {HANG_S:.0f} s"
    except Exception:
        outcome = traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    if _peak_mb() - before > MAX_GROWTH_MB:
        outcome = f"memory: {_peak_mb() - before:.0f} MB"
    return outcome


def keep(folder: Path, target: Target, name: str, data: bytes) -> Path:
    """Store a find under a name that says what reads it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{target.name}@{name.replace('/', '@')}@{hashlib.sha256(data).hexdigest()[:8]}"
    path.write_bytes(data)
    return path


def _hang(*_: object) -> None:
    raise Hang


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    sys.exit(main())
