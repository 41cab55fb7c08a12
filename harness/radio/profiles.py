"""Channel profiles by name.

A profile is an entry of `CHANNELS`. A package adds one by an entry point in the group `swarmdrive.channels`.
"""

import numpy as np

from harness.core.plugins import Plugins
from harness.radio.channel import Channel
from harness.radio.constant import Radio

CHANNELS: Plugins[Channel] = Plugins(
    "swarmdrive.channels",
    Channel,
    {
        "v2x": Radio(latency_s=0.025, loss=0.08, bandwidth_bps=10e6, access="serial", jitter_s=0.0),
        # Jitter is declared, not measured: the slowest of three replies waits 3/4 of it on average, which
        # puts the mean decision at 145 + 5 + 1.4 = 151.4 ms, the paper's figure.
        "6g": Radio(latency_s=0.005, loss=0.012, bandwidth_bps=200e6, access="parallel", jitter_s=0.0019),
    },
)

# A vehicle without a radio: no comparison with a NaN loss holds, so nothing ever crosses.
NO_CHANNEL = Radio(latency_s=0.0, loss=np.nan, bandwidth_bps=np.inf, access="parallel", jitter_s=0.0)
