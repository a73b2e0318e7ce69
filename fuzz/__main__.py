"""`python -m fuzz`: damaged files for as long as is wanted, and what went wrong with them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from fuzz.mutate import case
from fuzz.runner import Tally, fuzz


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000, help="how many files")
    parser.add_argument("--first", type=int, default=0, help="the number of the first")
    parser.add_argument("--workers", type=int, default=1, help="processes at a time")
    parser.add_argument(
        "--kinds", default="", help="of vdb,npy,npz,exr,png,job,batch,json; none: all"
    )
    parser.add_argument("--write", type=Path, help="write the file of case --first, and end")
    asked = parser.parse_args()
    if asked.write:
        made = case(asked.first, tuple(asked.kinds.split(",")) if asked.kinds else ())
        asked.write.write_bytes(made.raw)
        print(f"{asked.write}: {made.seed.name}, damaged")
        return 0
    numbers = range(asked.first, asked.first + asked.cases)
    told = 0
    with tqdm(total=asked.cases, unit=" files", file=sys.stderr, mininterval=1.0) as bar:

        def progress(tally: Tally) -> None:
            nonlocal told
            for finding in tally.findings[told:]:
                bar.write(f"case {finding.number}: {finding.what}\n")
            told = len(tally.findings)
            bar.set_postfix(findings=len(tally.findings), refresh=False)
            bar.update(tally.cases - bar.n)

        tally = fuzz(numbers, kinds=asked.kinds, workers=asked.workers, progress=progress)
    ends = ", ".join(f"{count:,} with {code}" for code, count in sorted(tally.codes.items()))
    print(f"{tally.cases:,} files: {len(tally.findings)} findings; ended {ends}")
    print(f"peak memory {tally.peak_bytes / 1e6:.0f} MB")
    return 1 if tally.findings else 0


if __name__ == "__main__":
    sys.exit(main())
