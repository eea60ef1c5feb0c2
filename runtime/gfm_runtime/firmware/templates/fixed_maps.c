/* @map dc-energy@ */
/* Half the square: column 1 of the error map. */
static int32_t half_square(int32_t value, int shift)
{
    return (int32_t)rounded(product(value, value), shift);
}

/* @map dvoc@ */
/* p/V^2, saturated: columns 2 and 4 of the error map. A dead bus must not divide by zero. */
static int32_t over_square(int32_t p, int32_t V, int32_t least, int64_t first, int64_t most,
    int64_t second, int32_t high)
{
    const int32_t v = V < least ? least : V;
    int64_t quotient = p * first / v;
    quotient = quotient < -most ? -most : quotient > most ? most : quotient;
    return between(quotient * second / v, -high, high);
}

/* @map hybrid-angle@ */
typedef struct {
    int64_t x, y;
} vector_t;

/* The direction of a vector: up to 2^30, the larger at least 2^29; or 0, 0. */
static vector_t direction(int64_t x, int64_t y)
{
    static const int64_t below[] = {INT64_C(1) << 30, INT64_C(1) << 46, INT64_C(1) << 54,
        INT64_C(1) << 58, INT64_C(1) << 60, INT64_C(1) << 61};
    static const int64_t times[] = {INT64_C(1) << 32, 65536, 256, 16, 4, 2};
    vector_t out;
    int i;
    for (i = 0; i < 6; i++) {
        if (x > -below[i] && x < below[i] && y > -below[i] && y < below[i]) {
            x *= times[i];
            y *= times[i];
        }
    }
    out.x = x >> 32;
    out.y = y >> 32;
    return out;
}

/* The integer below the square root of a number below 2^62. */
static int32_t root(int64_t square)
{
    int32_t found = 0;
    int bit;
    for (bit = 30; bit >= 0; bit--) {
        const int32_t next = found + (INT32_C(1) << bit);
        if (product(next, next) <= square) {
            found = next;
        }
    }
    return found;
}

/* sin((a - b)/2) 2^30 for the angles a and b of two vectors; 0 if one has no length. */
static int32_t sine_of_half(int64_t x_a, int64_t y_a, int64_t x_b, int64_t y_b)
{
    const int64_t one = INT64_C(1) << 30, half = one / 2;
    const vector_t a = direction(x_a, y_a), b = direction(x_b, y_b);
    const int64_t dot = a.x * b.x + a.y * b.y, cross = a.y * b.x - a.x * b.y;
    const vector_t turn = direction(dot, cross);
    const int64_t d = turn.x < 0 ? -turn.x : turn.x, c = turn.y < 0 ? -turn.y : turn.y;
    int64_t length = root(d * d + c * c), cosine, sine, larger;
    if ((a.x == 0 && a.y == 0) || (b.x == 0 && b.y == 0)) {
        return 0;
    }
    length = length < half ? half : length;
    cosine = d * one / length;
    larger = root((one + (cosine < one ? cosine : one)) * half);
    larger = larger < half ? half : larger;
    sine = c * one / length;
    sine = dot >= 0 ? (sine < one ? sine : one) * half / larger : larger;
    sine = ((y_a < 0) == (y_b < 0) ? cross < 0 : y_a < 0) ? -sine : sine;
    return between(sine, INT32_C(-1073741824), INT32_C(1073741824));
}

