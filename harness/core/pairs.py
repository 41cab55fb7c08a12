"""Settings in one text, as a command or a condition has them."""


def pairs(text: str) -> dict[str, str]:
    """Parse a text of settings, such as `loss=0.2,latency_s=0.01`, into a dict of texts by name.

    A missing value is an empty text.
    """
    parted = [pair.partition("=") for pair in text.split(",") if pair]
    return {key: value for key, _, value in parted}
