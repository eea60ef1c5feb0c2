"""``gfmhil bench``: measures the links, the clock, the kernel and the loop on this machine."""
