"""`harness serve`: a model, to be asked by others."""

import os

import typer

from harness.cli import options
from harness.core.errors import UserError, in_range, printable
from harness.runs.settings import HELP

TOKEN = "SWARMDRIVE_SERVE_TOKEN"
LEAST = 8  # characters of a token


def command(
    model: options.Model,
    engine: options.Engine = None,
    letters: str | None = typer.Option(None, help=HELP["letters"]),
    batch_size: int = typer.Option(
        1,
        help="Most questions that the model is asked together. With 1 none moves another's answer.",
    ),
    device: options.Device = None,
    dtype: options.Dtype = None,
    host: str = typer.Option(
        "127.0.0.1", help="Address to serve at. One that other machines reach needs a token."
    ),
    port: int = typer.Option(8080, help="Port; 0 picks a free one."),
    token: str | None = typer.Option(
        None,
        help=f"What clients must give as their API key. Default: the value of {TOKEN}, if any.",
    ),
    condition: str | None = typer.Option(
        None,
        help="Condition that says of each choice of action how to act on it: decide alone, ask "
        "helpers, or be careful. As 6g:promise=NAME it keeps a promise.",
    ),
    scenario: str | None = typer.Option(
        None, help="Scenario whose actions are chosen from under the --condition."
    ),
) -> None:
    """Serve a model's decisions to other programs.

    It answers POST /v1/systemone, POST /v1/decisions and GET /v1/models until Ctrl-C. A language
    model answers by a read-out of letters, a decision model as it does.
    """
    from harness.backends.cards import resolve
    from harness.backends.registry import open_backend
    from harness.coordination.named_points import named_point
    from harness.core import web
    from harness.extensions.decide.acts import Acts
    from harness.extensions.decide.app import CONNECTIONS, Service
    from harness.extensions.decide.model import ServedModel, served
    from harness.world import scenarios

    in_range("--port", port, 0, 65535)
    local, token = web.is_loopback(host), token or os.environ.get(TOKEN) or None
    if token is None and not local:
        raise UserError(
            f"--host {printable(host)}: other machines reach it; give a --token, or set {TOKEN}, "
            "or leave --host out"
        )
    if token is not None and not (token.isascii() and token.isprintable() and " " not in token):
        raise UserError("--token: it has characters that no key has; give letters and digits")
    if token is not None and len(token) < LEAST:
        raise UserError(f"--token: it has {len(token)} characters; give {LEAST} or more")
    if (condition is None) != (scenario is None):
        raise UserError("--condition and --scenario: give both, or neither")
    kept = None
    if condition is not None and scenario is not None:
        kept = named_point(condition), scenarios.get(scenario)
    agent = served(resolve(model, engine), letters)
    backend = open_backend(agent.card, device=device, dtype=dtype, batch_size=batch_size)
    acts = None
    if kept:
        acts = Acts(*kept, agent, backend.identity())
    service = Service(ServedModel(agent, backend), batch_size, token, local, acts)

    def listening(url: str) -> None:
        # Some clients add /v1 to the address that they are given.
        typer.echo(
            f"{url}/v1, or {url} for some clients, serves {printable(agent.card.name)} until Ctrl-C"
        )

    try:
        web.serve(service.app(), host, port, listening, limit_concurrency=CONNECTIONS)
    except KeyboardInterrupt:
        return
