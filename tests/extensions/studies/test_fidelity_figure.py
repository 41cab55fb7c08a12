"""The figure of `harness study fidelity`."""

import pandas as pd
from whole_figures import NAMES, check

from harness.extensions.studies.fidelity.figure import scatter


def test_nothing_sticks_out_of_it() -> None:
    known = {
        f"{world}{end}": 0.5 for world in ("frozen", "closed") for end in ("", "_low", "_high")
    }
    check(scatter(pd.DataFrame([{"condition": name} | known for name in NAMES]), NAMES))
