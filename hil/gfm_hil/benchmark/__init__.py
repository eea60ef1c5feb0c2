"""``gfmhil bench``: what the links, the clock, the kernel and the loop cost on this machine."""
