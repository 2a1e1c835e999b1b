"""Other processes and threads, for the tests that are about them."""

import contextlib
import socket
import subprocess
import sys
import threading

from tests.needs import ROOT
from tests.waiting import until


def subscribed(publisher, topic="contact", skin="palm", count=1):
    until(lambda: publisher.poll() or publisher.subscribers(topic, skin) == count)


@contextlib.contextmanager
def another(*command):
    """Another process of our Python, which says a line once it is ready; killed afterwards."""
    process = subprocess.Popen([sys.executable, *map(str, command)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline()
        yield process
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def served(*servers):
    """Control sockets, each served by a thread."""
    stop = threading.Event()

    def serve(server):
        while not stop.is_set():
            server.serve_once(0.02)
            server.mind()
        server.close()

    threads = [threading.Thread(target=serve, args=(server,)) for server in servers]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def free_port():
    with socket.socket() as own:
        own.bind(("127.0.0.1", 0))
        return own.getsockname()[1]
