"""How this extension's study is tried."""

from studied import BOTH, Trial

TRIALS = {
    "grid": Trial(
        "study grid --dataset data", f"--prompt v2,v3 --helper-prompt v2 {BOTH}", "--prompt v1,v2",
        "--out out already holds a finished grid; choose another",
        {
            "--prompt v2": "1 combinations: give 2 to 256, such as --model a,b",
            "--prompt v2,v2": "--prompt v2,v2: give different names, such as a,b",
            "--prompt v1,v2 --letters cyclic": 
                "--letters cyclic: proxy "
                "answers in json; leave it out",
        },
        "the same for all combinations", ends=False,
    ),
}  # fmt: skip
