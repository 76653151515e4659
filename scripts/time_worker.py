"""One method of the evaluation on call, for `measure_time.py`: a line in, the seconds of one pair out.

    python scripts/time_worker.py METHOD TRACK [CHECKOUT]

Lines are ``BENCHMARK NUMBER``; answers are JSON. CHECKOUT is a folder whose geomoe3d is taken in place of the installed
one, so that two states of the code can be run in turn.
"""

from __future__ import annotations

import json
import os
import sys
import time

if len(sys.argv) > 3:
    sys.path.insert(0, sys.argv[3])

from geomoe3d.evaluation.benchmarks import load_pairs
from geomoe3d.evaluation.methods import make_method
from geomoe3d.evaluation.tracks import InputMaker


def main() -> None:
    """Answer until there are no more lines; whatever libraries print goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    method, track = make_method(sys.argv[1]), sys.argv[2]
    pairs, makers = {}, {}
    for line in sys.stdin:
        benchmark, number = line.split()
        if benchmark not in pairs:
            pairs[benchmark], makers[benchmark] = load_pairs(benchmark), InputMaker(track, benchmark)
        given = makers[benchmark](pairs[benchmark][int(number)])
        wall, cpu = time.perf_counter(), time.process_time()
        answer = method(given)
        took = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "status": answer.status}
        stages = {name: float(seconds) for name, seconds in answer.stages.items()}
        print(json.dumps({**took, "stages": stages}), file=answers, flush=True)


if __name__ == "__main__":
    main()
