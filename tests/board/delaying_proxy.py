"""A TCP proxy that holds bytes up, sends pieces twice or in another order. Plain sockets and threads, none of the
project's code.

    python tests/board/delaying_proxy.py LISTEN_PORT BOARD_PORT [seconds of delay]

Between a board (`python -m firmware_stub --listen socket://127.0.0.1:BOARD_PORT`) and acquisition with
`port = "socket://127.0.0.1:LISTEN_PORT"`. What the board says is taken in pieces that a 0 ends, as its link has them;
what the host says passes at once, or after `delay_to_board_s`.
"""

import collections
import contextlib
import socket
import struct
import sys
import threading
import time

FRAME = 0x84  # number of a scan's message


def unstuffed(piece: bytes) -> bytes:
    """COBS decoded; b"" for what is none."""
    out, at = bytearray(), 0
    while at < len(piece):
        code = piece[at]
        if not code or at + code > len(piece):
            return b""
        out += piece[at + 1 : at + code]
        at += code
        if code < 255 and at < len(piece):
            out.append(0)
    return bytes(out)


class Held:
    """Pieces on their way in one direction, in order, each until its time."""

    def __init__(self) -> None:
        self.pieces: collections.deque[tuple[float, bytes]] = collections.deque()
        self.wake = threading.Condition()

    def put(self, due: float, piece: bytes) -> None:
        with self.wake:
            latest = self.pieces[-1][0] if self.pieces else due
            self.pieces.append((max(due, latest), piece))
            self.wake.notify()

    def take(self) -> bytes:
        """The next piece, once it is due; b"" after a while without any."""
        with self.wake:
            if not self.pieces:
                self.wake.wait(0.1)
                if not self.pieces:
                    return b""
            due = self.pieces[0][0]
        while (left := due - time.monotonic()) > 0:
            time.sleep(min(left, 0.05))
        with self.wake:
            return self.pieces.popleft()[1] if self.pieces else b""

    def clear(self) -> None:
        with self.wake:
            self.pieces.clear()


class DelayingProxy:
    """`delay_s`, `delay_to_board_s`, `repeat` and `reorder` may be changed at any time.

    entered: (number, device time [us]) of each scan -> monotonic ns when its last byte entered the proxy first.
    """

    def __init__(self, board: tuple[str, int], port: int = 0) -> None:
        self.delay_s = self.delay_to_board_s = 0.0
        self.repeat = self.reorder = False
        self.entered: dict[tuple[int, int], int] = {}
        self._board = board
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = self._server.getsockname()[1]
        self._open = True
        self._ends: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._open = False
        for end in (self._server, *self._ends):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        while self._open:
            try:
                host, _ = self._server.accept()
                board = socket.create_connection(self._board)
            except OSError:
                return
            self._ends += [host, board]
            for end in (host, board):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            up, down = Held(), Held()
            for work in (
                lambda board=board, up=up: self._from_board(board, up),
                lambda host=host, up=up: self._to(host, up),
                lambda host=host, down=down: self._from_host(host, down),
                lambda board=board, down=down: self._to(board, down),
            ):
                threading.Thread(target=work, daemon=True).start()

    def _from_board(self, board: socket.socket, up: Held) -> None:
        rest, kept = b"", b""
        with contextlib.suppress(OSError):
            while data := board.recv(65536):
                *pieces, rest = (rest + data).split(b"\0")
                for piece in filter(None, pieces):
                    self._note(piece)
                    line = b"\0" + piece + b"\0"
                    if self.reorder and not kept:
                        kept = line
                        continue
                    due = time.monotonic() + self.delay_s
                    up.put(due, line + kept if kept else line * (1 + self.repeat))
                    kept = b""

    def _note(self, piece: bytes) -> None:
        body = unstuffed(piece)
        if len(body) > 13 and body[0] == FRAME:
            seq, device_us = struct.unpack_from("<IQ", body, 1)
            self.entered.setdefault((seq, device_us), time.monotonic_ns())

    def _from_host(self, host: socket.socket, down: Held) -> None:
        with contextlib.suppress(OSError):
            while data := host.recv(65536):
                down.put(time.monotonic() + self.delay_to_board_s, data)

    def _to(self, end: socket.socket, held: Held) -> None:
        with contextlib.suppress(OSError):
            while self._open:
                if piece := held.take():
                    end.sendall(piece)


if __name__ == "__main__":
    proxy = DelayingProxy(("127.0.0.1", int(sys.argv[2])), int(sys.argv[1]))
    proxy.delay_s = float(sys.argv[3]) if len(sys.argv) > 3 else 0.0
    print(f"port {proxy.port}, delay {proxy.delay_s:g} s")
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(1)
