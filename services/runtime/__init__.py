"""What every process needs: configuration, stages and their channels, waiting, heartbeat, state kept, supervision."""
