"""Settings of Zenoh's links that clients, servers and routers share. It does not need Zenoh."""

from collections.abc import Mapping

# A silent peer is noticed after this time. Zenoh's default is ten seconds.
LEASE_MS = 5000
# In microseconds. Over Wi-Fi, sending a raw pair takes longer than the default of 50 ms, and every
# pair would be dropped. The wait for the first part is doubled for each one that follows, and its
# default of 1 ms drops the first large frames on a link of 20 Mbit/s. Credit limits how many wait.
WAITS_BEFORE_DROP: Mapping[str, int] = {
    "wait_before_drop": 100_000,
    "max_wait_before_drop_fragments": 500_000,
}
