"""What members of records are: their types, with the bounds that hold where a file is read."""

from typing import Annotated, Any, Literal
from warnings import warn

from msgspec import UNSET, Meta, Struct

from harness.core.seeds import LAST_EPISODE, LAST_SEED

Kind = Literal["car", "van", "truck", "bicycle", "motorcycle", "pedestrian"]  # of road users
Part = Literal["ego", "helper", "other"]
Side = Literal["own", "left", "right"]  # of the ego's ways, from the one that it is on
# No metre, second or share comes near these bounds, and infinity and huge integers do not pass
# them.
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Count = Annotated[int, Meta(ge=0, le=1_000_000)]
Seed = Annotated[int, Meta(ge=0, le=LAST_SEED + LAST_EPISODE)]
VehicleId = Annotated[str, Meta(pattern="^v[1-9][0-9]?$")]


class Closed(Struct, frozen=True, forbid_unknown_fields=True, gc=False):
    """Refuse unknown members when a record is decoded from a file; a base class of msgspec records.

    The bounds of `Annotated` field types are checked at decoding, too.
    """

    # gc=False: a record from a file has no cycles, and the collector would walk each of its parts.

    def __getitem__(self, key: str) -> Any:
        """Return a member by its name in a file:
        how plug-ins of 0.2 read it, until 0.5.0, with a warning.
        """
        names = dict(zip(self.__struct_encode_fields__, self.__struct_fields__, strict=True))
        if key not in names or (value := getattr(self, names[key])) is UNSET:
            raise KeyError(key)
        warn(f"[{key!r}] is now .{names[key]}; it works until 0.5.0", FutureWarning, stacklevel=2)
        return value
