/* One update of all tracks, for the usual case: one model of motion, and no doubt about the assignment.
 *
 * The same computation as MotionFilter.predict, assign and MotionFilter.update, which are the reference. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#define MAX_STATE 9
#define ROW 15 /* position (3), covariance (9), size (3) */

static double trace(const double *matrix, int64_t stride) { return matrix[0] + matrix[stride + 1] + matrix[2 * stride + 2]; }

/* inverse of a 3 x 3 matrix by cofactors */
static void inverse(double *out, const double *m)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
            out[3 * i + j] = m[3 * a + c] * m[3 * b + d] - m[3 * a + d] * m[3 * b + c];
        }
    double determinant = m[0] * out[0] + m[1] * out[3] + m[2] * out[6];
    for (int i = 0; i < 9; i++)
        out[i] /= determinant;
}

/* F x and F P F' + Q, where F has the blocks dt^(j-i) / (j-i)! I */
static void predict(double *x, double *P, double dt, double q, int64_t s)
{
    int64_t order = s / 3 - 1;
    double factor[3] = {1.0, dt, 0.5 * dt * dt}, weight[3] = {1.0, 1.0, 0.5}, *row, *column;
    for (int64_t i = 0; i < order; i++)
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                x[3 * i + c] += factor[k - i] * x[3 * k + c];
    for (int64_t i = 0; i < order; i++) /* rows of F P: row i needs rows below it, which are still old */
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                for (int64_t j = 0; j < s; j++) {
                    row = P + (3 * i + c) * s;
                    row[j] += factor[k - i] * P[(3 * k + c) * s + j];
                }
    for (int64_t i = 0; i < order; i++) /* columns of (F P) F' */
        for (int64_t k = i + 1; k <= order; k++)
            for (int c = 0; c < 3; c++)
                for (int64_t j = 0; j < s; j++) {
                    column = P + j * s + 3 * i + c;
                    *column += factor[k - i] * P[j * s + 3 * k + c];
                }
    for (int64_t i = 0; i <= order; i++)
        for (int64_t j = 0; j <= order; j++) {
            int64_t left = order - i, right = order - j, power = left + right + 1;
            double noise = q * weight[left] * weight[right] / (double)power * pow(dt, (double)power);
            for (int c = 0; c < 3; c++)
                P[(3 * i + c) * s + 3 * j + c] += noise;
        }
}

/* innovation nu and inverse of its covariance; returns the normalised innovation squared */
static double innovation(double *nu, double *inverted, const double *x, const double *P, const double *row, int64_t s)
{
    double S[9], squared = 0.0;
    for (int i = 0; i < 3; i++) {
        nu[i] = row[i] - x[i];
        for (int j = 0; j < 3; j++)
            S[3 * i + j] = P[i * s + j] + row[3 + 3 * i + j];
    }
    inverse(inverted, S);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            squared += nu[i] * inverted[3 * i + j] * nu[j];
    return squared;
}

/* x + K nu, and (I - K H) P (I - K H)' + K R K' = B - (B H' - K R) K' with B = P - K H P */
static void correct(double *x, double *P, const double *row, int64_t s)
{
    double nu[3], inverted[9], K[MAX_STATE * 3], top[3 * MAX_STATE], rest[3];
    const double *R = row + 3;
    innovation(nu, inverted, x, P, row, s);
    memcpy(top, P, sizeof(double) * 3 * (size_t)s);
    for (int64_t i = 0; i < s; i++)
        for (int j = 0; j < 3; j++)
            K[3 * i + j] = P[i * s] * inverted[j] + P[i * s + 1] * inverted[3 + j] + P[i * s + 2] * inverted[6 + j];
    for (int64_t i = 0; i < s; i++) {
        const double *k = K + 3 * i;
        x[i] += k[0] * nu[0] + k[1] * nu[1] + k[2] * nu[2];
        for (int64_t j = 0; j < s; j++)
            P[i * s + j] -= k[0] * top[j] + k[1] * top[s + j] + k[2] * top[2 * s + j];
        for (int j = 0; j < 3; j++)
            rest[j] = P[i * s + j] - (k[0] * R[j] + k[1] * R[3 + j] + k[2] * R[6 + j]);
        for (int64_t j = 0; j < s; j++)
            P[i * s + j] -= rest[0] * K[3 * j] + rest[1] * K[3 * j + 1] + rest[2] * K[3 * j + 2];
    }
}

/* Update n tracks with m detections. Returns 0, or 1 when the assignment is not obvious: then the results are void.
 *
 * Tracks with first[i] = 1 choose before the others, where it is 0.
 * states: in and out; states (n, s), covariances (n, s, s), then out: distances (n). rows (m, ROW).
 * indices: out: index of the detection of each track (n) or -1; then the track of each detection (m) or -1. */
int64_t track_kernel_update(int64_t n, int64_t m, int64_t s, double dt, double q, double gate, double max_speed,
                            double *states, const double *rows, const int8_t *first, int64_t *indices)
{
    double *x = states, *P = states + n * s, *distances = states + n * s + n * s * s;
    int64_t *detections = indices, *owners = indices + n;
    double nu[3], inverted[9];
    if (s > MAX_STATE || dt < 0.0)
        return 1;
    for (int64_t j = 0; j < m; j++) {
        owners[j] = -1;
        for (int64_t k = 0; k < j; k++) { /* two detections of one obstacle? */
            double squared = 0.0;
            for (int c = 0; c < 3; c++)
                squared += (rows[ROW * j + c] - rows[ROW * k + c]) * (rows[ROW * j + c] - rows[ROW * k + c]);
            if (squared <= gate * (trace(rows + ROW * j + 3, 3) + trace(rows + ROW * k + 3, 3)))
                return 1;
        }
    }
    for (int64_t i = 0; i < n; i++)
        predict(x + s * i, P + s * s * i, dt, q, s);
    for (int confirmed = 1; confirmed >= 0; confirmed--)
        for (int64_t i = 0; i < n; i++) {
            const double *xi = x + s * i, *Pi = P + s * s * i;
            if (first[i] != confirmed)
                continue;
            detections[i] = -1;
            for (int64_t j = 0; j < m; j++) {
                const double *row = rows + ROW * j;
                double squared = 0.0;
                if (owners[j] >= 0 && first[owners[j]] && !confirmed)
                    continue;
                for (int c = 0; c < 3; c++)
                    squared += (row[c] - xi[c]) * (row[c] - xi[c]);
                if (squared > gate * (trace(Pi, s) + trace(row + 3, 3)))
                    continue;
                double distance = innovation(nu, inverted, xi, Pi, row, s);
                if (!(distance <= gate))
                    continue;
                if (detections[i] >= 0 || owners[j] >= 0)
                    return 1;
                detections[i] = j;
                owners[j] = i;
                distances[i] = distance;
            }
        }
    for (int64_t i = 0; i < n; i++) {
        if (detections[i] < 0)
            continue;
        double *xi = x + s * i, squared = 0.0;
        correct(xi, P + s * s * i, rows + ROW * detections[i], s);
        for (int c = 3; c < 6; c++)
            squared += xi[c] * xi[c];
        if (squared > max_speed * max_speed)
            for (int c = 3; c < 6; c++)
                xi[c] *= max_speed / sqrt(squared);
    }
    return 0;
}
