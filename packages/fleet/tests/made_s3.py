"""A small S3 server for tests, with its objects in memory: it can be told to stall, fail or cut connections.

It knows what reading and writing need: HEAD, GET with Range, PUT, multipart uploads, listing, DELETE. No signature is
checked, but a key named `wrong` is refused as S3 refuses one.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

BUCKET = "arms"


@dataclass
class Object:
    content: bytes
    modified_s: float

    @property
    def etag(self) -> str:
        return f'"{hashlib.md5(self.content).hexdigest()}"'


@dataclass
class Request:
    """What a fault looks at."""

    method: str
    key: str
    range: str
    number: int
    """Of requests of this method for this key, from 1 on."""


@dataclass
class S3:
    """Objects by key, requests that came, and the fault that is put in."""

    objects: dict[str, Object] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    bytes_sent: int = 0
    fault: Callable[[Request], str | None] = lambda request: None
    """stall, cut, short, 503 or 403, or None; may change objects itself."""
    uploads: dict[str, dict[int, bytes]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    over: threading.Event = field(default_factory=threading.Event)
    port: int = 0

    def put(self, key: str, content: bytes) -> None:
        self.objects[key] = Object(content, time.time())

    def count(self, method: str, key: str) -> int:
        return sum(request.method == method and request.key == key for request in self.requests)


def s3_environment(port: int) -> dict[str, str]:
    """What a process needs to find a server on this port; it tries twice."""
    return {
        "AWS_ACCESS_KEY_ID": "tester",
        "AWS_SECRET_ACCESS_KEY": "secret-of-the-tester",
        "AWS_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "TAUEXT_STORE_TRIES": "2",
    }


@contextmanager
def s3_server() -> Iterator[S3]:
    """On a free port of loopback."""
    state = S3()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (Handler,), {"state": state}))
    server.daemon_threads = True
    state.port = server.server_address[1]
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield state
    finally:
        state.over.set()
        server.shutdown()
        server.server_close()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    state: S3

    def log_message(self, *_: object) -> None:
        pass

    def answer(self) -> None:
        method, url = self.command, urlsplit(self.path)
        query = parse_qs(url.query, keep_blank_values=True)
        bucket, _, key = unquote(url.path).removeprefix("/").partition("/")
        body = self.body()
        with self.state.lock:
            number = 1 + self.state.count(method, key)
            request = Request(method, key, self.headers.get("Range", ""), number)
            self.state.requests.append(request)
            fault = self.state.fault(request)
        if fault == "stall":
            self.state.over.wait(60)
            self.close_connection = True
            return
        if fault == "cut":
            self.close_connection = True
            self.connection.close()
            return
        if fault == "503":
            return self.refuse(503, "SlowDown", "Please reduce your request rate.")
        if fault == "403" or "Credential=wrong/" in self.headers.get("Authorization", ""):
            return self.refuse(403, "InvalidAccessKeyId", "The key is not known.")
        if bucket != BUCKET:
            return self.refuse(404, "NoSuchBucket", "The specified bucket does not exist")
        with self.state.lock:
            if method in ("HEAD", "GET") and not key:
                return self.listing(query) if "list-type" in query else self.send(200, b"")
            if method in ("HEAD", "GET"):
                return self.give(method, key, fault)
            if method == "PUT":
                return self.take(key, query, body)
            if method == "POST":
                return self.post(key, query, body)
            self.state.objects.pop(key, None)
            self.send(204, b"")

    do_HEAD = do_GET = do_PUT = do_POST = do_DELETE = answer

    def body(self) -> bytes:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.headers.get("Transfer-Encoding") == "chunked":
            while size := int(self.rfile.readline(), 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        if "aws-chunked" not in (self.headers.get("Content-Encoding") or ""):
            return body
        plain = b""
        while body:  # SIZE[;signature] CRLF content CRLF ... 0 CRLF trailers
            size, _, body = body.partition(b"\r\n")
            length = int(size.partition(b";")[0], 16)
            if not length:
                break
            plain, body = plain + body[:length], body[length + 2 :]
        return plain

    def give(self, method: str, key: str, fault: str | None) -> None:
        there = self.state.objects.get(key)
        if there is None:
            return self.refuse(404, "NoSuchKey", "The specified key does not exist.")
        content, status = there.content, 200
        stamp = formatdate(there.modified_s, usegmt=True)
        extra = {"ETag": there.etag, "Last-Modified": stamp, "Accept-Ranges": "bytes"}
        wanted = self.headers.get("Range", "")
        if wanted and method == "GET":
            first, _, last = wanted.removeprefix("bytes=").partition("-")
            end = min(int(last) + 1 if last else len(content), len(content))
            extra["Content-Range"] = f"bytes {first}-{end - 1}/{len(content)}"
            content, status = content[int(first) : end], 206
        if method == "HEAD":
            return self.send(status, b"", extra, length=len(content))
        if fault == "short":  # half of what it says, then the connection is gone
            self.send(status, content[: len(content) // 2], extra, length=len(content))
            self.close_connection = True
            return
        self.send(status, content, extra)

    def take(self, key: str, query: dict[str, list[str]], body: bytes) -> None:
        if "uploadId" in query:
            self.state.uploads[query["uploadId"][0]][int(query["partNumber"][0])] = body
        else:
            self.state.objects[key] = Object(body, time.time())
        self.send(200, b"", {"ETag": Object(body, 0).etag})

    def post(self, key: str, query: dict[str, list[str]], body: bytes) -> None:
        if "uploads" in query:
            number = f"upload-{len(self.state.uploads)}"
            self.state.uploads[number] = {}
            name = f"<Bucket>{BUCKET}</Bucket><Key>{escape(key)}</Key><UploadId>{number}</UploadId>"
            return self.send(200, f"<InitiateMultipartUploadResult>{name}</InitiateMultipartUploadResult>".encode())
        if "uploadId" in query:
            parts = self.state.uploads.pop(query["uploadId"][0])
            self.state.objects[key] = Object(b"".join(parts[k] for k in sorted(parts)), time.time())
            told = f"<Bucket>{BUCKET}</Bucket><Key>{escape(key)}</Key><ETag>{self.state.objects[key].etag}</ETag>"
            return self.send(200, f"<CompleteMultipartUploadResult>{told}</CompleteMultipartUploadResult>".encode())
        if "delete" in query:
            for text in body.decode().split("<Key>")[1:]:
                self.state.objects.pop(text.partition("</Key>")[0], None)
            return self.send(200, b"<DeleteResult></DeleteResult>")
        self.refuse(400, "InvalidRequest", "not known here")

    def listing(self, query: dict[str, list[str]]) -> None:
        prefix, delimiter = query.get("prefix", [""])[0], query.get("delimiter", [""])[0]
        found, folders = [], set()
        for key, there in sorted(self.state.objects.items()):
            if not key.startswith(prefix):
                continue
            rest = key[len(prefix) :]
            if delimiter and delimiter in rest:
                folders.add(prefix + rest.partition(delimiter)[0] + delimiter)
                continue
            stamp = time.strftime("%Y-%m-%dT%H:%M:%S.000Z", time.gmtime(there.modified_s))
            found.append(
                f"<Contents><Key>{escape(key)}</Key><LastModified>{stamp}</LastModified><ETag>{there.etag}</ETag>"
                f"<Size>{len(there.content)}</Size></Contents>"
            )
        most = int(query.get("max-keys", ["1000"])[0])
        found = found[:most]
        common = "".join(f"<CommonPrefixes><Prefix>{escape(one)}</Prefix></CommonPrefixes>" for one in sorted(folders))
        head = f"<Name>{BUCKET}</Name><Prefix>{escape(prefix)}</Prefix><KeyCount>{len(found) + len(folders)}</KeyCount>"
        body = f"<ListBucketResult>{head}<IsTruncated>false</IsTruncated>{''.join(found)}{common}</ListBucketResult>"
        self.send(200, body.encode())

    def refuse(self, status: int, code: str, message: str) -> None:
        body = f"<Error><Code>{code}</Code><Message>{message}</Message></Error>".encode()
        self.send(status, b"" if self.command == "HEAD" else body)

    def send(self, status: int, body: bytes, extra: dict[str, str] | None = None, length: int | None = None) -> None:
        self.send_response(status)
        for name, value in (extra or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        if body.startswith(b"<"):
            self.send_header("Content-Type", "application/xml")
        self.end_headers()
        self.wfile.write(body)
        self.state.bytes_sent += len(body)


def upload(server: S3, folder: Path, name: str = "data") -> None:
    for path in folder.rglob("*"):
        if path.is_file():
            server.put(f"{name}/{path.relative_to(folder).as_posix()}", path.read_bytes())
