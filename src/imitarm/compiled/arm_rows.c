/* Rows of the safety filter: gradients of the distances of an arm's spheres to obstacles and to each other.
 *
 * The same computation as ClearanceLimit and SelfClearance in NumPy, which are the reference. */

#include "shapes.h"

#include <math.h>
#include <stdlib.h>

/* An arm in one posture: m spheres, each moved by some of the n joints.
 *
 * moves (m, n): 1 where a joint moves a sphere, else 0; dofs (n): rows of cdof, MuJoCo's twists of the joints about
 * the centre of mass com. */
typedef struct {
    int64_t n, m;
    const double *moves;
    const int64_t *dofs;
    const double *cdof, *com;
} Arm;

/* Speed at which each joint moves a point along n; zero for joints whose factor in moves is 0. */
static void speeds(double *row, const Arm *arm, const double *point, const double *n, const double *outer,
                   const double *inner)
{
    double a = point[0] - arm->com[0], b = point[1] - arm->com[1], c = point[2] - arm->com[2];
    double torque[3] = {b * n[2] - c * n[1], c * n[0] - a * n[2], a * n[1] - b * n[0]};
    for (int64_t k = 0; k < arm->n; k++) {
        const double *twist = arm->cdof + 6 * arm->dofs[k];
        double factor = outer[k] - (inner ? inner[k] : 0.0);
        double speed = torque[0] * twist[0] + torque[1] * twist[1] + torque[2] * twist[2];
        row[k] = factor * (speed + n[0] * twist[3] + n[1] * twist[4] + n[2] * twist[5]);
    }
}

/* Find all pairs of an obstacle and a sphere that are within the reach of the sphere.
 *
 * centers (m, 3); reach (m). Out: for each of at most n_obstacles * m pairs, indices of obstacle and sphere (2 each),
 * the distance, the speed of the obstacle's nearest point along the normal and the variance of the obstacle's position
 * along the normal (3 each), and the row (n each). Returns the number of pairs. */
int64_t obstacle_rows(const Obstacles *obstacles, double dt, const Arm *arm, const double *centers, const double *reach,
                      int64_t *indices, double *values, double *rows)
{
    int64_t found = 0;
    Solid solid;
    for (int64_t i = 0; i < obstacles->n; i++) {
        const double *v = obstacles->velocities + 3 * i, *w = obstacles->rates + 3 * i;
        const double *P = obstacles->covariances + 9 * i;
        place(&solid, obstacles, i, dt);
        for (int64_t j = 0; j < arm->m; j++) {
            const double *c = centers + 3 * j;
            double d[3] = {c[0] - solid.center[0], c[1] - solid.center[1], c[2] - solid.center[2]}, n[3];
            double limit = reach[j] + solid.radius;
            if (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > limit * limit)
                continue;
            double distance = signed_distance(&solid, c, n);
            if (!(distance <= reach[j]))
                continue;
            double *value = values + 3 * found;
            indices[2 * found] = i;
            indices[2 * found + 1] = j;
            value[0] = distance;
            value[1] = n[0] * (v[0] + w[1] * d[2] - w[2] * d[1]) + n[1] * (v[1] + w[2] * d[0] - w[0] * d[2]) +
                       n[2] * (v[2] + w[0] * d[1] - w[1] * d[0]);
            value[2] = 0.0;
            for (int r = 0; r < 3; r++)
                value[2] += n[r] * (P[3 * r] * n[0] + P[3 * r + 1] * n[1] + P[3 * r + 2] * n[2]);
            speeds(rows + arm->n * found, arm, c, n, arm->moves + arm->n * j, 0);
            found++;
        }
    }
    return found;
}

typedef struct {
    double distance;
    int64_t index;
} Pair;

static int nearer(const void *a, const void *b)
{
    const Pair *one = a, *other = b;
    if (one->distance != other->distance)
        return one->distance < other->distance ? -1 : 1;
    return one->index < other->index ? -1 : one->index > other->index;
}

/* Pairs of spheres of two links: group k begins with pair starts[k]; sums are the sums of the two radii. */
typedef struct {
    int64_t n_pairs, n_groups;
    const int64_t *outer, *inner;
    const double *sums;
    const int64_t *starts;
} SpherePairs;

/* Find every pair nearer than close, at most the nearest `most`, and the nearest pair of each of the n_rows nearest
 * groups that are nearer than near.
 *
 * centers (m, 3): first those of the arm, which has moves, then those of the base. scratch: room for n_pairs + n_groups
 * pairs. Out: the pairs' indices in SpherePairs, ordered by distance, their distances, and their rows (n each).
 * Returns their number, at most most + n_rows. */
int64_t self_rows(const SpherePairs *pairs, const Arm *arm, const double *centers, int64_t n_rows, double near,
                  double close, int64_t most, Pair *scratch, int64_t *indices, double *distances, double *rows)
{
    Pair *best = scratch, *chosen = scratch + pairs->n_groups;
    int64_t n_close = 0, found = 0;
    for (int64_t g = 0; g < pairs->n_groups; g++) {
        int64_t end = g + 1 < pairs->n_groups ? pairs->starts[g + 1] : pairs->n_pairs;
        best[g].distance = INFINITY;
        best[g].index = pairs->starts[g];
        for (int64_t k = pairs->starts[g]; k < end; k++) {
            const double *a = centers + 3 * pairs->outer[k], *b = centers + 3 * pairs->inner[k];
            double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
            double distance = sqrt(x * x + y * y + z * z) - pairs->sums[k];
            if (distance < best[g].distance) {
                best[g].distance = distance;
                best[g].index = k;
            }
            if (distance < close) {
                chosen[n_close].distance = distance;
                chosen[n_close++].index = k;
            }
        }
    }
    qsort(best, (size_t)pairs->n_groups, sizeof(Pair), nearer);
    qsort(chosen, (size_t)n_close, sizeof(Pair), nearer);
    int64_t kept = n_close < most ? n_close : most;
    for (int64_t g = 0; g < n_rows && g < pairs->n_groups && best[g].distance < near; g++) {
        int known = 0;
        for (int64_t k = 0; k < kept && !known; k++)
            known = chosen[k].index == best[g].index;
        if (!known)
            best[found++] = best[g];
    }
    for (int64_t k = 0, a = 0, b = 0; k < kept + found; k++) { /* merge both, which are in order */
        Pair pair = b >= found || (a < kept && nearer(chosen + a, best + b) < 0) ? chosen[a++] : best[b++];
        const double *one = centers + 3 * pairs->outer[pair.index], *other = centers + 3 * pairs->inner[pair.index];
        double length = pair.distance + pairs->sums[pair.index], normal[3];
        const double *moved = arm->moves + arm->n * pairs->outer[pair.index];
        const double *inner = pairs->inner[pair.index] < arm->m ? arm->moves + arm->n * pairs->inner[pair.index] : 0;
        for (int c = 0; c < 3; c++)
            normal[c] = (one[c] - other[c]) / length;
        indices[k] = pair.index;
        distances[k] = pair.distance;
        speeds(rows + arm->n * k, arm, one, normal, moved, inner);
    }
    return kept + found;
}
