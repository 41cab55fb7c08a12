"""Who may read the pages: only who has the token that `harness view` printed, and no other site.

A machine may have several users, and each can reach its loopback interface; so can every page in a
browser. The address that is printed holds the token; its answer is a cookie, and the address
without it. Requests that another site causes are refused, except that a link may open a page in a
tab, where that site cannot read it. (A run's own page is such a site, since it lies in a sandbox,
and has links to others.)
"""

from secrets import compare_digest

from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from harness.extensions.view import pages

TOKEN = "token"


def cookie(port: int) -> str:
    """Return the name of the cookie that holds the secret token of a server on a port.

    Browsers send the cookies of one port to all ports, so the name has the port.
    """
    return f"swarmdrive-view-{port}"


class Access:
    """Guard the pages, as ASGI middleware: answer 403 to requests without the token.

    It is made from the app that it guards and the secret token, which a request has in its address
    or in a cookie. Requests that another website causes are refused, too; all others are passed on.
    """

    def __init__(self, app: ASGIApp, token: str) -> None:
        self.app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        answer = self._answer(Request(scope)) if scope["type"] == "http" else None
        await (answer or self.app)(scope, receive, send)

    def _answer(self, request: Request) -> Response | None:
        """Return the answer to a request that is not passed on."""
        name = cookie(request.scope["server"][1])
        if _of_another_site(request):
            return _refused("another site asked for this page; open it from the list of runs")
        if (given := request.query_params.get(TOKEN)) is not None and self._is(given):
            # With its host, since a path that begins with // would lead to another.
            answer = RedirectResponse(str(request.url.remove_query_params(TOKEN)), 303)
            # Not `strict`: a page in a sandbox is another site, and the link back to the list is in
            # it.
            answer.set_cookie(name, self._token, httponly=True, samesite="lax")
            return answer
        if given is None and self._is(request.cookies.get(name, "")):
            return None
        return _refused("open the address that `harness view` printed, with its token")

    def _is(self, given: str) -> bool:
        return compare_digest(given.encode(), self._token.encode())


def _of_another_site(request: Request) -> bool:
    headers = request.headers
    opens_tab = (headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest")) == (
        "navigate",
        "document",
    )
    caused_by = headers.get("sec-fetch-site", "none")  # browsers say so; other programs do not
    origin = headers.get("origin")
    return (caused_by not in ("none", "same-origin") and not opens_tab) or (
        origin is not None and origin != f"{request.url.scheme}://{headers.get('host')}"
    )


def _refused(reason: str) -> Response:
    # What is left of the request is not read.
    return HTMLResponse(pages.wrong(reason), 403, {"connection": "close"})
