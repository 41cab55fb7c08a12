"""Settings in one text, as a command or a condition has them."""


def pairs(text: str) -> dict[str, str]:
    """Return the names and values in `density_per_km=200,power_dbm=23`;
    a missing value is empty.
    """
    parted = [pair.partition("=") for pair in text.split(",") if pair]
    return {key: value for key, _, value in parted}
