"""Ask a server on this machine over HTTP."""

import http.client
from contextlib import closing


def port_of(url: str) -> int:
    return int(url.rsplit(":", 1)[1].strip("/"))


def asked(port: int, path: str, **headers: str) -> tuple[int, bytes]:
    """Request a path and return status and body. The default `Host` is the server's; an empty header is not sent."""
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)) as connection:
        connection.putrequest("GET", path, skip_host=True)
        for name, value in ({"Host": f"127.0.0.1:{port}"} | headers).items():
            if value:
                connection.putheader(name, value.format(port=port))
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read()
