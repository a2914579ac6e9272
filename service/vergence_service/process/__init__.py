"""What belongs to the process as a whole: threads, memory, descriptors, metrics and the log."""
