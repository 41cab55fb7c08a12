"""How this extension's study is tried."""

from studied import ASKED, Trial

TRIALS = {
    "trust": Trial(
        "study trust run", "--attacks liar,liar+spoof --rules median,trust --share 1/3",
        "--attacks liar,liar+spoof --rules median,trust --share 1/3 --seeds 7:8",
        "run/trust holds another trust, with other seeds; name another folder",
        {
            "--prompt v4": 
                "give either RUN, the folder of a finished "
                "run, or --model, with its --prompt",
            "--share 0,2": "--share 0,2: give shares from 0 to 1",
            "--attacks liar,lair": "unknown --attacks 'lair'",
        },
        "under 6g", out="", folder="run/trust", beside=ASKED,
    ),
}  # fmt: skip
