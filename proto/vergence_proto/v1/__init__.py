"""Generated from depth.proto by ``python proto/generate.py``; never edited."""
