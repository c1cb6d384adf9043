"""Real cameras: a stream over ZeroMQ, what OpenCV opens, and GenICam."""
