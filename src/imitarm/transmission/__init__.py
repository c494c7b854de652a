"""Communication between capture, retargeting and robot: messages, datagrams, UDP sockets, fixed rates, latency."""
