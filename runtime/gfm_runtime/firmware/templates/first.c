/* @if counts@ */
enum { NADC = @GUARD@_NADC, NIN = NADC, NCMP = @GUARD@_NCMP, NOUT = NU + NCMP };

static void to_adc(const real in[], uint16_t adc[])
{
    int i;
    for (i = 0; i < NADC; i++)
        adc[i] = !(in[i] > 0) ? 0 : in[i] < UINT16_MAX ? (uint16_t)in[i] : UINT16_MAX;
}

/* @else@ */
enum { NIN = NY, NOUT = NU };

/* @end@ */
/* Sets the states so that the outputs begin at u. */
static int begin(law_t *s, const real ref[], const real in[], const real u[])
{
    static const real trend[@N_ROWS@] = {0};
    real own[@N_ROWS@];
    int i;
/* @if counts@ */
    uint16_t adc[NADC];
    law_t first;
/* @end@ */
    for (i = 0; i < @N_ROWS@; i++)
        own[i] = u[i];
/* @if counts@ */
    to_adc(in, adc);
    @P@_align(s, adc);
    first = *s;
    i = @P@_sense(&first, adc);
    return i != @GUARD@_OK ? i : @P@_settle(s, ref, first.counts.sensed, own, trend@E_IN_USE@);
/* @else@ */
    return @P@_settle(s, ref, in, own, trend@E_IN_USE@);
/* @end@ */
}

/* A tick. */
static int go_on(law_t *s, const real ref[], const real in[], real u[])
{
/* @if counts@ */
    uint16_t adc[NADC], cmp[NCMP + 1];
    int i, reason;
    to_adc(in, adc);
    reason = @P@_isr(s, ref, adc, u, cmp);
    for (i = 0; i < NCMP && cmp[NCMP] != 0; i++)
        u[NU + i] = (real)cmp[i];
    return reason;
/* @else@ */
    return @P@_step(s, ref, in, u);
/* @end@ */
}
