
/* @if own@ */
IN_PLACE int @P@_step(@LAW@@P@_t *s, const real ref[], const real y[], real u[])
/* @else@ */
int @P@_step(@LAW@@P@_t *s, const real ref[], const real y[], real u[])
/* @end@ */
{
    tick_t t;
    return ticked(@law@s, ref, y, u, &t, refused(s, ref, y, &s->channel));
}

static int sensed(@LAW@@P@_t *s, const uint16_t adc[], tick_t *t)
{
    real counts[@GUARD@_NADC];
    int i;
    if (s->reason != @GUARD@_OK) {
        return s->reason;
    }
    for (i = 0; i < @GUARD@_NADC; i++) {
        counts[i] = (real)adc[i];
    }
    @MEASURE@;
    if (t->suspect >= 0) {
        s->channel = t->suspect;
        s->reason = @GUARD@_BAD_SENSOR;
    }
    return s->reason;
}

int @P@_sense(@LAW@@P@_t *s, const uint16_t adc[])
{
    tick_t t;
    return sensed(@law@s, adc, &t);
}

/* @if own@ */
IN_PLACE int @P@_isr(@LAW@@P@_t *s, const real ref[], const uint16_t adc[], real u[], uint16_t cmp[])
/* @else@ */
int @P@_isr(@LAW@@P@_t *s, const real ref[], const uint16_t adc[], real u[], uint16_t cmp[])
/* @end@ */
{
    tick_t t;
    int i, reason = sensed(@law@s, adc, &t);
    cmp[@GUARD@_NCMP] = 0;
    if (reason != @GUARD@_OK) {
        return reason;
    }
    reason = out_of_range(ref, s->counts.sensed, &s->channel);
    reason = ticked(@law@s, ref, s->counts.sensed, u, &t, reason);
    if (reason == @GUARD@_OK) {
        @MODULATE@;
        for (i = 0; i < @GUARD@_NCMP; i++) {
            cmp[i] = (uint16_t)t.compare[i];
        }
        cmp[@GUARD@_NCMP] = 1;
    }
    return reason;
}

void @P@_align(@LAW@@P@_t *s, const uint16_t adc[])
{
    tick_t t;
    real counts[@GUARD@_NADC];
    int i;
    for (i = 0; i < @GUARD@_NADC; i++) {
        counts[i] = (real)adc[i];
    }
    @ALIGN@;
}

int @P@_calibrate(@LAW@@P@_t *s, const uint16_t adc[])
{
    tick_t t;
    real counts[@GUARD@_NADC];
    int i;
    for (i = 0; i < @GUARD@_NADC; i++) {
        counts[i] = (real)adc[i];
    }
    @CALIBRATE@;
    if (t.suspect >= 0) {
        s->channel = t.suspect;
        s->reason = @GUARD@_BAD_SENSOR;
    }
    return s->reason;
}
