"""What the fork server of workers imports first: the kernel then ends it with the command."""

import signal

from gfm_runtime.children import end_with_parent

end_with_parent(by=signal.SIGKILL)
