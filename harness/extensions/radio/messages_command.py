"""`harness radio messages`: what messages take by the standards' encodings."""

import typer

from harness.cli import options
from harness.cli.terminal import echo_json, table
from harness.core.errors import UserError, in_range, printable, unknown
from harness.core.figures import Unit
from harness.extensions.radio.commands import channel_of


def command(
    name: str | None = typer.Argument(None, help="Message whose members to list, such as CPM."),
    objects: int = typer.Option(3, help="Objects that a CPM or an SDSM lists, 0 to 255."),
    optional: bool = typer.Option(
        True,
        help="Whether objects have what is optional and scene graphs know: in a CPM speed, heading "
        "and "
        "class, in an SDSM class and lights.",
    ),
    points: int = typer.Option(0, help="Points of the path behind in a CAM or BSM, 0 to 23."),
    actions: int = typer.Option(
        3, help="Probabilities in an intent, 0 to 255; 0 leaves its words."
    ),
    text_bytes: int = typer.Option(60, help="Bytes of an intent's evidence, 0 to 10000."),
    helpers: int = typer.Option(3, help="Helpers that a request asks, 1 to 1000."),
    channel: str | None = typer.Option(
        None, help="Physical radio, such as its-g5: adds the time on air."
    ),
    as_json: options.Json = False,
) -> None:
    """Show what messages take as ETSI and SAE encode them.

    Sizes are in bytes. The envelope is signed, with a digest of the sender's certificate or, now
    and then, the certificate. The headers are those of network and transport. With a message's
    name, its members are listed, in bits.
    """
    from harness.extensions.radio.messages import NAMES, Counts, shares, size, wraps
    from harness.extensions.radio.transceiver import Transceiver

    in_range("--objects", objects, 0, 255)
    in_range("--points", points, 0, 23)
    in_range("--actions", actions, 0, 255)
    in_range("--text-bytes", text_bytes, 0, 10_000)
    in_range("--helpers", helpers, 1, 1000)
    content = Counts(objects, optional, points, actions, text_bytes, helpers)
    names = [name for names in NAMES.values() for name in names.values()]
    if name is not None and name not in names:
        raise unknown("message", name, names)
    radio = channel_of(channel)[1] if channel else None
    if radio is not None and not isinstance(radio, Transceiver):
        raise UserError(f"--channel {printable(channel)}: give a physical radio, such as its-g5")
    sizes = {each: size(each, content) for each in ([name] if name else names)}
    airtimes_s = {}
    for message, bits in sizes.items():
        if radio and bits.packet:
            airtimes_s[message] = float(radio.message_s(bits.packet))
    members = []
    if name and (bits_of_message := sizes[name].message):
        every_share = (*shares(name, content), *wraps(name, bits_of_message))
        members = [share for share in every_share if share.bits]
    if as_json:
        rows = []
        for message, bits in sizes.items():
            parts = {f"{part}_bits": float(value) for part, value in bits._asdict().items()}
            rows.append({"message": message, **parts, "airtime_s": airtimes_s.get(message)})
        shares_of_members = [
            {"member": ".".join(share.path), "bits": float(share.bits), "source": share.source}
            for share in members
        ]
        content_of_messages = content._asdict()
        echo_json({"content": content_of_messages, "messages": rows, "members": shares_of_members})
        return
    heads = ["bytes", "message", "envelope", "headers", "packet", "with certificate"]
    if radio:
        heads.append("on air, ms")
    ms = Unit(decimals=2, factor=1000)
    lines = []
    for message, bits in sizes.items():
        cells = [message, *(f"{value / 8:g}" for value in bits)]
        if radio:
            cells.append(ms.number(airtimes_s.get(message)))
        lines.append(cells)
    table(heads, lines)
    if members:
        typer.echo()
        table(["bits", ""], [(".".join(share.path), f"{share.bits:g}") for share in members])
