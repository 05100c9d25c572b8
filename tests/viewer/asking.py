"""One request to a server, as a program that knows its token could make it."""

from __future__ import annotations

import http.client

from stages.viewer.server import LocalServer


def ask(server: LocalServer, path: str, method: str = "GET") -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest(method, server.root + path)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body, dict(answer.getheaders())
