import pytest
import zmq

from protocol import transport
from protocol.sockets import Publisher


@pytest.fixture
def context():
    """What the test leaves open is closed with it; the transport that it configures is put back."""
    own = zmq.Context()
    yield own
    transport.configure(transport.Transport())
    transport.stop_gate(own)
    own.destroy(linger=0)


@pytest.fixture
def publisher(runtime, context):
    made = Publisher("publisher", context)
    yield made
    made.close()
