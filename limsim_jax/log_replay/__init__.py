"""Log replay: recorded vehicles follow their logs, and the traffic model takes over where an ego deviates."""
