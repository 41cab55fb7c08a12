"""Read a picture out of a data URL; nothing is fetched and no file is opened."""

import re
from base64 import b64decode
from binascii import Error
from io import BytesIO

import numpy as np

from harness.core import extras
from harness.core.errors import UserError, one_line
from harness.core.image import Image
from harness.extensions.decide.asked import Refusal

MOST_PX = 2**20  # of a picture: 3 MB each that waits
_URL = re.compile(r"data:image/(png|jpeg);base64,", re.IGNORECASE)


def picture(url: str) -> Image:
    """Return the picture in a data URL of a PNG or JPEG, which holds the file itself.

    Raises Refusal if it is none, cannot be read, or is too large.
    """
    if not (head := _URL.match(url)):
        raise Refusal(
            "a picture is no data URL of a PNG or JPEG; nothing is fetched", code="picture"
        )
    try:
        extras.need("reading a picture", "PIL")
    except UserError as error:
        raise Refusal(str(error), code="picture") from None
    import PIL.Image

    try:
        file = PIL.Image.open(
            BytesIO(b64decode(url[head.end() :], validate=True)), formats=("PNG", "JPEG")
        )
        if file.width * file.height > MOST_PX:  # known from its head
            raise Refusal(
                f"a picture has {file.width} x {file.height} pixels; give at most {MOST_PX}",
                code="picture",
            )
        return Image(np.asarray(file.convert("RGB")))
    except (Error, OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        raise Refusal(f"a picture cannot be read: {one_line(error)}", code="picture") from None
