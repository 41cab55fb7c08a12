"""How this extension's studies are tried."""

from studied import ASKED, BOTH, Trial

TRIALS = {
    "repeats": Trial(
        "study repeats --dataset data --model "
        "swarm-tiny --no-cache", f"--repeats 3 --temperature 0.7 {BOTH}",
        "--repeats 3 --temperature 0.8", 
            "--out out already holds finished "
            "repeats; choose another folder",
        {
            "--repeats 3": 
                "--repeats 3: greedy answers are the same "
                "every time; give a --temperature above",
            "--repeats 1 --temperature 1": "--repeats 1 is out of range; give 2 to 100",
            "--repeats 3 --temperature 3": 
                "--temperature 3: give 0, which "
                "takes the likeliest token",
            "--repeats 3 --temperature "
            "1 --latency measured": "--latency measured: it needs an idle",
            "--repeats 3 --temperature 1 --answer readout": "a readout is a distribution already",
            "--repeats 3 --temperature 1 --model proxy": "proxy has nothing to sample; leave it",
        },
        "they differ only in the random draws", ends=False,
    ),
    "twins": Trial(
        "study twins --dataset data", "--sample 3 --workers 1", "--sample 2 --workers 1",
        "--out out already holds finished twins; choose another folder",
        {
            "--twin mirrord": "did you mean 'mirrored'?",
            "--model full-view": "reads the truth",
            "--twin units": "units needs a language model",
            "--twin mirrored --dataset roundabout-entry-v1": "traffic goes round one way",
            "--fail-if 'ids:success_rate < 1'": "known: failed_rate, invariance_rate, tv_distance",
            "--fail-if 'letters:invariance_rate < 1'": "unknown twin of --fail-if",
            "--fail-if 'mirrored:invariance_rate < 90'": "invariance_rate is from 0 to 1, where 0.01",
            "--fail-if often": "such as 'mirrored:invariance_rate < 0.9'",
            "--sample 0": "--sample 0",
        },
        "the number of questions that the twin changes", ends=False,
    ),
    "fidelity": Trial(
        "study fidelity", "run driven", "copy driven",
        "out holds another fidelity, with other sources; name another folder",
        {"run": "no run on live episodes", "run nowhere": "nowhere is no finished run"},
        "driving on with a planner that sees everything",
    ),
    "attribution": Trial(  # which lies in its run's folder
        "study attribute run", "--sample 6", "--sample 7", "",
        {
            "--sample 0": "--sample 0 is out of range; give 1 to 100000",
            "--condition 7g": "unknown condition '7g'",
        },
        "", out="", folder="run", beside=ASKED,
    ),
}  # fmt: skip
