"""The pages of `harness view`: what each address answers, and what it may not.

Nobody who sends a request can name a file. A run is looked up in the listing of the folder, a
picture among the files of its study; both are compared as text, so `..`, absolute and encoded paths
name nothing. What is then opened must lie in the folder itself (`folder.py`). What a run says it
was made of, its prompt and its dataset, is read as by `harness report`: shown only if it has the
digest that the run noted.

Nobody without the token gets anything (`access.py`), and other sites get nothing: names other than
this machine's are refused, which ends DNS rebinding, and no page may be framed, embedded or, but
for a note, posted to. The list runs no script but, while a run goes on, one of its own that asks
how far that is. A run's page is as untrusted as the run's author, so pages are kept apart from the
list and from each other: `sandbox` gives them an origin of their own, from which they can read
nothing here, and they may load nothing. Their inline scripts may run as far as their own policy
lets them, and save files if they are clicked. Browsers show no page that is both in a sandbox and
`same-origin` with its opener, so these are not.
"""

import asyncio
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from threading import Thread
from urllib.parse import parse_qs, urlencode

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from harness.core.errors import UserError, printable
from harness.extensions.view import pages
from harness.extensions.view.access import Access
from harness.extensions.view.folder import PICTURES, own_file, pictures, whole
from harness.extensions.view.notes import FILE as NOTES
from harness.report.library import digest
from harness.runs.listing import Listed, runs

SENT_S = 30.0  # within which a form must have come
CLOSED = {"connection": "close"}  # of what is left of a request nothing is read
MOST_SENT = 1 << 16  # bytes of a form: every character of a note may take twelve
HOSTS = ("127.0.0.1", "localhost")
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'self'; img-src 'self' data:; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
# Of the list while a run goes on: it may run the one script that asks here how far that is.
OF_LIST = {
    "Content-Security-Policy": f"{HEADERS['Content-Security-Policy']}; "
    f"script-src 'sha256-{digest(pages.script())}'; connect-src 'self'",
}
OF_RUNS = {  # in the place of those above, for what a run's folder holds
    "Content-Security-Policy": "default-src 'none'; script-src "
    "'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "sandbox allow-scripts allow-downloads",
    "Cross-Origin-Opener-Policy": "unsafe-none",
}


def app(folder: Path, token: str) -> ASGIApp:
    """Return the web application that `harness view` serves for one folder of runs.

    Requests need the secret `token`, in the address or in a cookie, so that other users of the
    machine see nothing.
    """
    view = View(folder)
    routes = {
        "/": view.index,
        "/progress": view.progress,
        "/style.css": view.style,
        "/run": view.run,
        "/picture": view.picture,
        "/compare": view.compare,
        "/report": view.report,
        "/notes": view.notes,
    }
    return _Guarded(
        Starlette(
            routes=[
                *(Route(path, page, methods=["GET"]) for path, page in routes.items()),
                Route("/notes", view.note, methods=["POST"]),  # the one address that writes
            ],
            middleware=[
                Middleware(TrustedHostMiddleware, allowed_hosts=HOSTS, www_redirect=False),
                Middleware(Access, token=token),
            ],
            exception_handlers={
                UserError: view.wrong,
                HTTPException: view.wrong,
                Exception: view.bug,
            },
        )
    )


class _Guarded:
    """Gives every answer, errors included, `HEADERS` where it has none of its own."""

    def __init__(self, within: ASGIApp) -> None:
        self.within = within

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self.within(scope, receive, sent)


class View:
    """Answer the requests of the web application for one folder of runs, a method for each address.

    Each takes the request and returns the page or file. Files are read in threads; pages that take
    seconds are made one at a time.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._drawing = asyncio.Lock()  # a page holds all rows of its runs
        self._writing = asyncio.Lock()  # all notes of a run are one file

    def index(self, request: Request) -> Response:
        query = request.query_params
        page = pages.listed(self.folder, query.get("q", ""), query.get("sort", ""))
        return HTMLResponse(page, headers=OF_LIST if "<script>" in page else None)

    def progress(self, request: Request) -> Response:
        """Return as JSON what changes in the list of runs while runs go on.

        It has `listed`, a digest that changes once a run begins or ends; `going`, whether one goes
        on; and `unfinished`, how far each is in words, by its name. `request` is not read.
        """
        every = runs(self.folder)
        return JSONResponse(pages.now(every, pages.extents(self.folder, every)))

    def style(self, request: Request) -> Response:
        return Response(pages.style(), media_type="text/css")

    async def run(self, request: Request) -> Response:
        [run] = await run_in_threadpool(self._listed, [request.query_params.get("path", "")])
        if run.state != "finished":
            raise UserError(
                f"{printable(run.name)} is {run.state} ({printable(run.why)}); it has no page yet"
            )
        if run.kind == "suite":
            return await self._drawn(request, partial(pages.suite, self.folder, run.name))
        if run.kind not in pages.RUNS:
            return await run_in_threadpool(self._study, run)
        written, *made_of = (
            own_file(self.folder, run.name, name) for name in ("report.html", "run.json", NOTES)
        )
        scene = request.query_params.get("scene")
        drawn = [file.stat().st_mtime for file in made_of if file]
        if not (written and drawn and written.stat().st_mtime >= max(drawn)):
            written = None
        links = [pages.to_notes(run.name, scene)]
        if written and scene is None:
            return await run_in_threadpool(_page, written, links)
        return await self._drawn(
            request, partial(pages.report, self._whole([run]), written, scene), links
        )

    async def notes(self, request: Request) -> Response:
        """Return the page with the notes on a run's decisions, and a form for another.

        The address has the run's name, `path`, and may have the decision point's id, `scene`.
        """
        [run] = await run_in_threadpool(self._picked, request)
        [path] = self._whole([run])
        scene = request.query_params.get("scene", "")
        # With the usual policy of referrers, browsers would not say which site sends the form.
        page = await run_in_threadpool(pages.notes, path, run.name, scene)
        return HTMLResponse(page, headers={"Referrer-Policy": "same-origin"})

    async def note(self, request: Request) -> Response:
        """Write the note that a form sent, and lead back to the page of the run's notes.

        The form has `path` (the run's name), `scene` (the decision point's id), `text` and `before`
        (the date of the note that is replaced). A request that names no origin is refused here;
        `Access` refuses one from another origin.
        """
        if "origin" not in request.headers:
            raise HTTPException(
                403, "it is not said which site sends this; send it from a page of this list"
            )
        sent = b""
        try:
            async with asyncio.timeout(SENT_S):
                async for chunk in request.stream():
                    sent += chunk
                    if len(sent) > MOST_SENT:
                        raise HTTPException(
                            413, "this is longer than a note may be; shorten it", CLOSED
                        )
        except TimeoutError:
            late = f"a note did not come within {SENT_S:g} s; send it again"
            raise HTTPException(408, late, CLOSED) from None
        except ClientDisconnect:
            raise HTTPException(
                400, "the browser is gone, and nothing was written", CLOSED
            ) from None
        form = parse_qs(sent.decode("ascii", "replace"), keep_blank_values=True, errors="replace")
        keys = ("path", "scene", "text", "before")
        name, *note = (form.get(key, [""])[0] for key in keys)
        [run] = await run_in_threadpool(self._runs, [name])
        [path] = self._whole([run])
        async with self._writing:
            await run_in_threadpool(pages.note, path, *note)
        return RedirectResponse(f"/notes?{urlencode({'path': run.name})}", 303)

    def picture(self, request: Request) -> Response:
        [run] = self._listed([request.query_params.get("path", "")])
        name = request.query_params.get("name", "")
        file = (
            own_file(self.folder, run.name, name)
            if name in pictures(self.folder, run.name)
            else None
        )
        if file is None:
            raise HTTPException(
                404, f"{printable(run.name)} has no picture {printable(name)}; see its page"
            )
        policy = {
            "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; sandbox",
            "Cross-Origin-Opener-Policy": "unsafe-none",
        }
        return FileResponse(file, headers=policy, media_type=PICTURES[file.suffix])

    async def compare(self, request: Request) -> Response:
        """Return the page that compares two runs, named by two values of `path` in the address.

        Run A is the one that `a` in the address names, else the one that began first.
        """
        picked = await run_in_threadpool(self._picked, request)
        if len(picked) != 2:
            raise UserError(f"{len(picked)} runs are picked; pick two to compare them")
        first = request.query_params.get("a")
        a, b = sorted(picked, key=lambda each: (each.name != first, each.date))
        page = partial(pages.compared, self.folder, *self._whole([a, b]))
        return await self._drawn(request, page, pages.around(a.name, b.name))

    async def report(self, request: Request) -> Response:
        picked = await run_in_threadpool(self._picked, request)
        if not picked:
            raise UserError("no run is picked; pick one or more for a report")
        scene = request.query_params.get("scene")
        return await self._drawn(request, partial(pages.report, self._whole(picked), None, scene))

    def wrong(self, request: Request, error: Exception) -> Response:
        """Return an error page of one line, with the error's HTTP status, 400 for a UserError.

        `request` is not read.
        """
        status, reason = (
            (error.status_code, error.detail) if isinstance(error, HTTPException) else (400, error)
        )
        headers = error.headers if isinstance(error, HTTPException) else None
        return HTMLResponse(pages.wrong(str(reason)), status, headers)

    def bug(self, request: Request, error: Exception) -> Response:
        """Return an error page of one line for a bug (status 500), and print its traceback.

        `error` is what was raised; `request` is not read.
        """
        traceback.print_exception(error)
        return HTMLResponse(pages.wrong("this page cannot be made; the terminal says why"), 500)

    def _listed(self, names: Sequence[str]) -> Sequence[Listed]:
        by_name = {run.name: run for run in runs(self.folder)}
        for name in names:
            if name not in by_name:
                raise HTTPException(
                    404, f"no run {printable(name)!r} in {printable(self.folder)}; see the list"
                )
        return [by_name[name] for name in names]

    def _picked(self, request: Request) -> Sequence[Listed]:
        return self._runs(list(dict.fromkeys(request.query_params.getlist("path"))))

    def _runs(self, names: Sequence[str]) -> Sequence[Listed]:
        listed = self._listed(names)
        for run in listed:
            if run.state != "finished" or run.kind not in pages.RUNS:
                raise UserError(f"{printable(run.name)} is no finished run of a model; pick others")
        return listed

    def _whole(self, picked: Sequence[Listed]) -> Sequence[Path]:
        return [whole(self.folder, run.name) for run in picked]

    def _study(self, run: Listed) -> Response:
        page = own_file(self.folder, run.name, "index.html")
        if page:
            return _page(page)
        return HTMLResponse(pages.study(run, pictures(self.folder, run.name)))

    async def _drawn(
        self, request: Request, page: Callable[[], str], links: Sequence[tuple[str, str]] = ()
    ) -> Response:
        drawn: Future[str] = Future()
        drawn.set_running_or_notify_cancel()

        def make() -> None:
            try:
                drawn.set_result(page())
            except BaseException as error:
                drawn.set_exception(error)

        async with self._drawing:
            if await request.is_disconnected():  # while others' pages were drawn
                return Response(status_code=204)
            # No pool: Ctrl-C would wait for the threads of one.
            Thread(target=make, daemon=True).start()
            return _with_way_back(await asyncio.wrap_future(drawn), links)


def _page(page: Path, links: Sequence[tuple[str, str]] = ()) -> Response:
    return _with_way_back(pages.whole_text(page), links)


def _with_way_back(page: str, links: Sequence[tuple[str, str]] = ()) -> Response:
    return HTMLResponse(pages.with_way_back(page, links), headers=OF_RUNS)
