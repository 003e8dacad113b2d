"""Command line of the benchmarks: ``python -m benchmarks.verification --out FOLDER``."""

import argparse
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from benchmarks.verification.cases import CASES
from benchmarks.verification.report import run_case, update


def main() -> int:
    """Run the benchmarks and write the report; 1 if a quantity missed its tolerance."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verification", description=__doc__)
    parser.add_argument("--out", required=True, type=Path, help="folder of the report")
    parser.add_argument("--case", action="append", choices=list(CASES), help="this case only")
    parser.add_argument("--quick", action="store_true", help="the reduced size of the tests")
    parser.add_argument("--jobs", type=int, default=2, help="cases that run at the same time")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    missed = 0
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        waiting = [
            pool.submit(run_case, name, str(options.out), options.quick)
            for name in options.case or CASES
        ]
        for done in as_completed(waiting):
            result = done.result()
            update(options.out, [result])
            beyond = [row["quantity"] for row in result["rows"] if not row["passed"]]
            missed += len(beyond)
            print(f"{result['case']}: {len(result['rows'])} quantities, {result['seconds']} s")
            for quantity in beyond:
                print(f"  beyond its tolerance: {quantity}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
