static @T@_t @P@_of[3];

static void @P@_do_init(int k)
{
    @T@_init(&@P@_of[k]);
}

static void @P@_do_reset(int k)
{
    @T@_reset(&@P@_of[k]);
}

/* @if counts@ */
static void @P@_to_adc(const golden_real *y, uint16_t *adc)
{
    int i;
    for (i = 0; i < GOLDEN_NY; i++) {
        adc[i] = (uint16_t)y[i];
    }
}

/* @end@ */
static int @P@_do_step(int k, const golden_real *ref, const golden_real *y, golden_real *u)
{
    @T@_t *s = &@P@_of[k];
    unsigned long start = GOLDEN_CLOCK(), reading = GOLDEN_CLOCK() - start;
    int result;
/* @if counts@ */
    uint16_t adc[GOLDEN_NY], cmp[4];
    int i;
    @P@_to_adc(y, adc);
    start = GOLDEN_CLOCK();
    result = @T@_isr(@ARGUMENT@s, ref, adc, u, cmp);
    golden_elapsed = GOLDEN_CLOCK() - start - reading; /* of the call, not of the clock */
    for (i = 0; i < 3 && cmp[3] != 0; i++) {
        u[GOLDEN_OF_STEP + i] = (golden_real)cmp[i];
    }
/* @else@ */
    start = GOLDEN_CLOCK();
    result = @T@_step(@ARGUMENT@s, ref, y, u);
    golden_elapsed = GOLDEN_CLOCK() - start - reading; /* of the call, not of the clock */
/* @end@ */
    return result;
}

static int @P@_do_look(int k, const golden_real *ref, const golden_real *y, golden_real *u)
{
    return @T@_look(@ARGUMENT@&@P@_of[k], ref, y, u);
}

static int @P@_do_settle(int k, const golden_real *ref, const golden_real *y, golden_real *u,
    const golden_real *trend@E@)
{
    return @T@_settle(@ARGUMENT@&@P@_of[k], ref, y, u, trend@e@);
}

static int @P@_do_change(int k, const golden_real *ref, const golden_real *y, golden_real *u,
    const golden_real *trend@E@, golden_real *bump)
{
    return @T@_switch(@ARGUMENT@&@P@_of[k], ref, y, u, trend@e@, bump);
}

static view_t @P@_do_view(int k)
{
    const @T@_t *s = &@P@_of[k];
/* @if counts@ */
    static golden_real stage[GOLDEN_STAGE], counts[GOLDEN_COUNTS];
    const view_t view = {s->x, s->offset, s->u, s->trend, @N@, stage, s->stage.e, s->limited, counts};
    memcpy(stage, &s->stage, sizeof stage);
    memcpy(counts, &s->counts, sizeof counts);
    return view;
/* @elif stages@ */
    static golden_real stage[GOLDEN_STAGE];
    const view_t view = {s->x, s->offset, s->u, s->trend, @N@, stage, s->stage.e, s->limited};
    memcpy(stage, &s->stage, sizeof stage);
    return view;
/* @elif fixed@ */
    static golden_real rest[2 * @REST@];
    const view_t view = {s->x, s->offset, s->u, s->trend, @N@, rest, 2 * @REST@};
    int i;
    for (i = 0; i < @REST@; i++) {
        rest[2 * i] = (golden_real)(s->rest[i] & INT32_MAX);
        rest[2 * i + 1] = (golden_real)(s->rest[i] >> 31);
    }
    return view;
/* @else@ */
    const view_t view = {s->x, s->offset, s->u, s->trend, @N@};
    return view;
/* @end@ */
}

/* @if counts@ */
static void @P@_do_align(int k, const golden_real *y)
{
    uint16_t adc[GOLDEN_NY];
    @P@_to_adc(y, adc);
    @T@_align(@ARGUMENT@&@P@_of[k], adc);
}

static void @P@_do_calibrate(int k, const golden_real *y)
{
    uint16_t adc[GOLDEN_NY];
    @P@_to_adc(y, adc);
    (void)@T@_calibrate(@ARGUMENT@&@P@_of[k], adc);
}

static void @P@_do_go_on(int k, const golden_real *counts)
{
    memcpy(&@P@_of[k].counts, counts, sizeof @P@_of[k].counts);
}

/* @end@ */
/* @if tuned@ */
static void @P@_do_tune(int k, int set)
{
    static const @P@_gains_t sets[] = {
        @SETS@
    };
    (void)@P@_tune(&@P@_of[k], &sets[set]);
}

/* @end@ */
static void @P@_do_spoil(int k, int stage)
{
/* @if fixed@ */
    (void)k;
    (void)stage;
/* @else@ */
    golden_real *place = &@P@_of[k].offset[0];
/* @if stages@ */
    if (stage)
        place = &@P@_of[k].stage.away[0];
/* @else@ */
    (void)stage;
/* @end@ */
    memset(place, 0xff, sizeof *place); /* NaN */
/* @end@ */
}

