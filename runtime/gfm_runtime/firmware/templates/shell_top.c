#include "@P@.h"

#include <float.h>
#include <limits.h>
#include <math.h> /* fabs, which is no call, and sqrt */
#include <stdbool.h>

@GUARDS@

typedef @P@_real real;

/* What a tick works on beside the state. */
@TICK@
@FUNCTIONS@
