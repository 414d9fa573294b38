"""Pages as the server passes requests on to them, without a socket."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass

PORT, TOKEN = 4711, "the-token"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    content: bytes

    @property
    def text(self):
        return self.content.decode()

    def json(self):
        return json.loads(self.content)


class ServedPage:
    """A page that is served: an ASGI application ``app``."""

    def request(self, path, content=None, kind="http", **headers):
        text = {"host": f"127.0.0.1:{PORT}", **headers}
        scope = {
            "type": kind, "method": "GET" if content is None else "POST", "path": path,
            "raw_path": path.encode(), "query_string": b"", "root_path": "", "scheme": "http",
            "headers": [(k.encode(), v.encode()) for k, v in text.items()],
            "http_version": "1.1", "client": None, "server": ("127.0.0.1", PORT),
            "extensions": {"websocket.http.response": {}},
        }  # fmt: skip
        sent = []

        async def receive():
            return {"type": "http.request", "body": content or b""}

        async def send(message):
            sent.append(message)

        asyncio.run(self.app(scope, receive, send))
        start = sent[0]
        headers = {k.decode(): v.decode() for k, v in start["headers"]}
        return Answer(start["status"], headers, b"".join(m.get("body", b"") for m in sent[1:]))

    def get(self, path="", token=TOKEN, **headers):
        return self.request(f"/{token}/{path}", **headers)
