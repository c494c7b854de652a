/* The joint velocity of least cost inside a box that keeps given rows: the quadratic program of the inverse kinematics.
 *
 * The same problem as quadratic_program in imitarm.kinematics.ik, which solves it with daqp. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#define MAX_JOINTS 64
#define MAX_STEPS 200
#define SINGULAR 1e-12 /* a squared pivot below this belongs to a direction in which the arm can't move */
#define VIOLATED 1e-11 /* [rad/s] along a row: less is rounding */
#define DEPENDENT 1e-14 /* squared relative length below which a row depends on the active rows */

typedef struct {
    int64_t n, m;
    const double *lower, *upper, *A, *b; /* lower <= x <= upper, and A x >= b with m rows */
} Limits;

/* A violated limit: row i >= 0, the lower bound -1 - 2 j of joint j, or its upper bound -2 - 2 j. */
typedef struct {
    int64_t which;
    double missing, c[MAX_JOINTS]; /* what is missing, and the limit's gradient in the coordinates y */
} Limit;

/* Replace H (n, n) by its lower triangular factor L, where H = L L'; returns whether H is positive definite. */
static int factorize(double *H, int64_t n)
{
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j <= i; j++) {
            double sum = H[n * i + j];
            for (int64_t k = 0; k < j; k++)
                sum -= H[n * i + k] * H[n * j + k];
            if (i == j && !(sum > SINGULAR))
                return 0;
            H[n * i + j] = i == j ? sqrt(sum) : sum / H[n * j + j];
        }
    return 1;
}

/* y = L^-1 a */
static void forward(double *y, const double *L, const double *a, int64_t n)
{
    for (int64_t i = 0; i < n; i++) {
        double sum = a[i];
        for (int64_t k = 0; k < i; k++)
            sum -= L[n * i + k] * y[k];
        y[i] = sum / L[n * i + i];
    }
}

/* x = L^-T y */
static void backward(double *x, const double *L, const double *y, int64_t n)
{
    for (int64_t i = n - 1; i >= 0; i--) {
        double sum = y[i];
        for (int64_t k = i + 1; k < n; k++)
            sum -= L[n * k + i] * x[k];
        x[i] = sum / L[n * i + i];
    }
}

static double product(const double *a, const double *b, int64_t n)
{
    double sum = 0.0;
    for (int64_t k = 0; k < n; k++)
        sum += a[k] * b[k];
    return sum;
}

/* Find the limit that x violates most, in rad/s; returns whether there is one. */
static int most_violated(Limit *found, const Limits *limits, const double *x)
{
    double most = VIOLATED;
    int any = 0;
    for (int64_t j = 0; j < limits->n; j++) {
        double below = limits->lower[j] - x[j], above = x[j] - limits->upper[j];
        double missing = below > above ? below : above;
        if (missing > most) {
            most = found->missing = missing;
            found->which = below > above ? -1 - 2 * j : -2 - 2 * j;
            any = 1;
        }
    }
    for (int64_t i = 0; i < limits->m; i++) {
        const double *row = limits->A + limits->n * i;
        double missing = limits->b[i] - product(row, x, limits->n);
        if (missing > 0.0 && missing > most * sqrt(product(row, row, limits->n))) {
            most = missing / sqrt(product(row, row, limits->n));
            found->missing = missing;
            found->which = i;
            any = 1;
        }
    }
    return any;
}

/* Set the gradient of a limit in the coordinates y. */
static void set_gradient(Limit *limit, const Limits *limits, const double *L)
{
    double a[MAX_JOINTS];
    if (limit->which >= 0) {
        forward(limit->c, L, limits->A + limits->n * limit->which, limits->n);
        return;
    }
    int64_t j = (-1 - limit->which) / 2;
    memset(a, 0, sizeof a);
    a[j] = (-1 - limit->which) % 2 ? -1.0 : 1.0;
    forward(limit->c, L, a, limits->n);
}

/* Subtract from v its parts along k orthonormal rows; twice, because rounding leaves some of them. */
static void orthogonalize(double *v, double *parts, const double *basis, int64_t k, int64_t n)
{
    memset(parts, 0, (size_t)k * sizeof *parts);
    for (int twice = 0; twice < 2; twice++)
        for (int64_t i = 0; i < k; i++) {
            double part = product(basis + n * i, v, n);
            parts[i] += part;
            for (int64_t j = 0; j < n; j++)
                v[j] -= part * basis[n * i + j];
        }
}

/* Split c into the sum of r[k] times the gradient of active limit k, and the rest z that is orthogonal to them all.
 *
 * The active gradients are made orthonormal again in each call: there are few. */
static void split(double *r, double *z, const Limit *active, int64_t q, const double *c, int64_t n)
{
    double basis[MAX_JOINTS * MAX_JOINTS], columns[MAX_JOINTS * MAX_JOINTS];
    for (int64_t k = 0; k < q; k++) {
        double *v = basis + n * k;
        memcpy(v, active[k].c, (size_t)n * sizeof *v);
        orthogonalize(v, columns + n * k, basis, k, n);
        double length = columns[n * k + k] = sqrt(product(v, v, n));
        for (int64_t j = 0; j < n; j++)
            v[j] /= length;
    }
    memcpy(z, c, (size_t)n * sizeof *z);
    orthogonalize(z, r, basis, q, n);
    for (int64_t k = q - 1; k >= 0; k--) {
        for (int64_t i = k + 1; i < q; i++)
            r[k] -= columns[n * i + k] * r[i];
        r[k] /= columns[n * k + k];
    }
}

/* Minimise |y - y_0|^2 / 2 = x' H x / 2 - f' x with y = L' x, by the dual method of Goldfarb and Idnani (1983): limits
 * that are violated become active one by one, and the multiplier u of each active limit stays positive. y is y_0 at
 * first. Returns 0, or 1 if the limits contradict each other. */
static int64_t project(double *x, double *y, const double *L, const Limits *limits)
{
    Limit active[MAX_JOINTS], next;
    double u[MAX_JOINTS + 1], r[MAX_JOINTS], z[MAX_JOINTS];
    int64_t q = 0, n = limits->n;
    for (int64_t step = 0; step < MAX_STEPS; step++) {
        backward(x, L, y, n);
        if (!most_violated(&next, limits, x))
            return 0;
        set_gradient(&next, limits, L);
        double multiplier = 0.0, length = product(next.c, next.c, n);
        for (int added = 0; !added; step++) {
            int64_t blocking = -1;
            double most = INFINITY;
            if (step >= MAX_STEPS)
                return 1;
            split(r, z, active, q, next.c, n);
            for (int64_t k = 0; k < q; k++)
                if (r[k] > 0.0 && u[k] < most * r[k]) {
                    most = u[k] / r[k];
                    blocking = k;
                }
            double rest = q < n ? product(z, z, n) : 0.0;
            double whole = rest > DEPENDENT * length ? next.missing / rest : INFINITY;
            double size = whole < most ? whole : most;
            if (isinf(size))
                return 1;
            for (int64_t k = 0; k < q; k++)
                u[k] -= size * r[k];
            multiplier += size;
            if (!isinf(whole)) {
                for (int64_t j = 0; j < n; j++)
                    y[j] += size * z[j];
                next.missing -= size * rest;
            }
            added = whole <= most;
            if (!added) { /* the multiplier of an active limit is 0 now */
                q--;
                memmove(active + blocking, active + blocking + 1, (size_t)(q - blocking) * sizeof *active);
                memmove(u + blocking, u + blocking + 1, (size_t)(q - blocking) * sizeof *u);
            }
        }
        active[q] = next;
        u[q++] = multiplier;
    }
    return 1;
}

/* Minimise |J x - t|^2 / 2 + effort |x|^2 / 2 + change |x - v|^2 / 2 inside limits.
 *
 * J (k, n), t (k); v (n), may be null: then change has no effect. lower, upper (n). A (m, n), b (m). Out: x (n), in the
 * box. Returns 0, or 1 when the limits contradict each other, or the problem is too large or too badly conditioned. */
int64_t least_cost_velocity(int64_t n, int64_t k, const double *J, const double *t, double effort, double change,
                            const double *v, const double *lower, const double *upper, int64_t m, const double *A,
                            const double *b, double *x)
{
    double H[MAX_JOINTS * MAX_JOINTS], f[MAX_JOINTS], y[MAX_JOINTS];
    Limits limits = {n, m, lower, upper, A, b};
    if (n > MAX_JOINTS)
        return 1;
    for (int64_t i = 0; i < n; i++) {
        f[i] = v ? change * v[i] : 0.0;
        for (int64_t a = 0; a < k; a++)
            f[i] += J[n * a + i] * t[a];
        for (int64_t j = 0; j <= i; j++) {
            H[n * i + j] = i == j ? effort + (v ? change : 0.0) : 0.0;
            for (int64_t a = 0; a < k; a++)
                H[n * i + j] += J[n * a + i] * J[n * a + j];
        }
    }
    if (!factorize(H, n))
        return 1;
    forward(y, H, f, n);
    if (project(x, y, H, &limits))
        return 1;
    for (int64_t j = 0; j < n; j++)
        x[j] = x[j] < lower[j] ? lower[j] : x[j] > upper[j] ? upper[j] : x[j];
    return 0;
}
