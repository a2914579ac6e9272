"""The messages of the Open Inference Protocol v2, and the code generated from them."""
