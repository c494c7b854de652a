"""Communication between capture, retargeting and robot: messages, datagrams, UDP sockets, rates and latencies."""
