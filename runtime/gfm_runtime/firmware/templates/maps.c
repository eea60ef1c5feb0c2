/* @map dc-energy@ */
/* Column 1: the error (V_dcref^2 - v_dc^2)/2, [Zhang2010] in the paper. */
static void dc_energy(real r[], real y[])
{
    r[0] = @0.5@ * r[0] * r[0];
    y[0] = @0.5@ * y[0] * y[0];
}

/* @map dvoc@ */
/* Columns 2 and 4: P_ref/V_ref^2 - p/V^2 and Q_ref/V_ref^2 - q/V^2, [Tayyebi2020] in the paper.
 * A dead bus must not divide by zero. */
static void dvoc(real r[], real y[])
{
    real v_ref = @V_MIN@ > r[4] ? @V_MIN@ : r[4];
    real v = @V_MIN@ > y[4] ? @V_MIN@ : y[4];
    r[1] /= v_ref * v_ref;
    r[3] /= v_ref * v_ref;
    y[1] /= v * v;
    y[3] /= v * v;
}

/* @map hybrid-angle@ */
/* sin((a - b)/2) for the angles a and b of two vectors, from their dot and cross products; 0 if one
 * has no length. */
static real sine_of_half(real x_a, real y_a, real x_b, real y_b)
{
    real dot = x_a * x_b + y_a * y_b, cross = y_a * x_b - x_a * y_b;
    real length = @sqrt@(dot * dot + cross * cross), larger, sine;
    bool a_below = y_a < @0@, b_below = y_b < @0@;
    if (!(length >= @R_MIN@)) {
        return @0@;
    }
    larger = @sqrt@(@0.5@ + @0.5@ * @fabs@(dot / length));
    sine = dot >= @0@ ? @0.5@ * @fabs@(cross / length) / larger : larger;
    return (a_below == b_below ? cross < @0@ : a_below) ? -sine : sine;
}

/* Column 2: sin((delta_ref - delta)/2), [Tayyebi2020hybrid] in the paper; delta is the angle across
 * the impedance R + jX (p.u.). */
static void hybrid_angle(real R, real X, real r[], real y[])
{
    r[1] = sine_of_half(r[4] * r[4] - (R * r[1] + X * r[3]), X * r[1] - R * r[3],
        y[4] * y[4] - (R * y[1] + X * y[3]), X * y[1] - R * y[3]);
    y[1] = @0@;
}

