/* Rows of the safety filter: gradients of the distances of an arm's spheres to obstacles and to each other.
 *
 * The same computation as ClearanceLimit and SelfClearance in NumPy, which are the reference. */

#include "shapes.h"

#include <math.h>
#include <stdlib.h>

#define ROUNDING 1e-9 /* [m/s] so that no row is left out too early because of rounding */
#define MAX_JOINTS 64

/* An arm in one posture: m spheres, each moved by some of the n joints.
 *
 * moves (m, n): 1 where a joint moves a sphere, else 0; dofs (n): rows of cdof, MuJoCo's twists of the joints about
 * the centre of mass com; owners (m), local (m, 3): body and local place of each sphere; rotations, origins: MuJoCo's
 * poses of all bodies. */
typedef struct {
    int64_t n, m;
    const double *moves;
    const int64_t *dofs;
    const double *cdof, *com;
    const int64_t *owners;
    const double *local, *rotations, *origins;
} Arm;

/* Centres of the spheres, shape (m, 3). */
int64_t sphere_centers(const Arm *arm, double *centers)
{
    for (int64_t j = 0; j < arm->m; j++) {
        const double *R = arm->rotations + 9 * arm->owners[j], *p = arm->origins + 3 * arm->owners[j];
        const double *x = arm->local + 3 * j;
        for (int r = 0; r < 3; r++)
            centers[3 * j + r] = p[r] + (R[3 * r] * x[0] + R[3 * r + 1] * x[1] + R[3 * r + 2] * x[2]);
    }
    return 0;
}

/* Velocity of a point for a unit velocity of each joint, shape (n, 3); 0 for joints whose factor in moves is 0. */
static void point_jacobian(double *jacobian, const Arm *arm, const double *point, const double *moves)
{
    double a = point[0] - arm->com[0], b = point[1] - arm->com[1], c = point[2] - arm->com[2];
    for (int64_t k = 0; k < arm->n; k++) {
        const double *w = arm->cdof + 6 * arm->dofs[k], *v = w + 3;
        double *column = jacobian + 3 * k, factor = moves[k];
        if (factor == 0.0) {
            column[0] = column[1] = column[2] = 0.0;
            continue;
        }
        column[0] = factor * (v[0] + w[1] * c - w[2] * b);
        column[1] = factor * (v[1] + w[2] * a - w[0] * c);
        column[2] = factor * (v[2] + w[0] * b - w[1] * a);
    }
}

/* Velocity along a normal for a unit velocity of each joint. */
static void along(double *row, const double *jacobian, const double *normal, int64_t n)
{
    for (int64_t k = 0; k < n; k++)
        row[k] = normal[0] * jacobian[3 * k] + normal[1] * jacobian[3 * k + 1] + normal[2] * jacobian[3 * k + 2];
}

/* The largest speed of a point within bounds of the joint velocity. */
static double fastest(const double *jacobian, const double *lower, const double *upper, int64_t n)
{
    double sum = 0.0;
    for (int64_t k = 0; k < n; k++) {
        const double *column = jacobian + 3 * k;
        double most = fabs(lower[k]) > fabs(upper[k]) ? fabs(lower[k]) : fabs(upper[k]);
        double squared = column[0] * column[0] + column[1] * column[1] + column[2] * column[2];
        sum += squared > 0.0 ? most * sqrt(squared) : 0.0;
    }
    return sum;
}

/* How fast a distance may shrink; arrays and numbers as in ClearanceLimit and shrink_rates, where they are explained.
 *
 * reduced (m); accelerations, velocities (n): limits of the joints. */
typedef struct {
    const double *reduced, *accelerations, *velocities;
    double delay, rate, retreat, deviations, share, longest, unmoved;
} Limit;

/* Time in which the joints can brake to rest; a null velocity is at rest. */
static double braking_time(const Limit *limit, const double *velocity, int64_t n)
{
    double longest = 0.0;
    for (int64_t k = 0; velocity && k < n; k++)
        longest = fmax(longest, fabs(velocity[k]) / limit->accelerations[k]);
    return longest;
}

/* The least allowed derivative of the remaining distance `room`, when the obstacle approaches at a speed. */
static double bound(const Limit *limit, const double *row, int64_t n, double room, double approach, double delay,
                    double braking)
{
    double time = 0.0;
    if (approach > 0.0) {
        double acceleration = 0.0, velocity = 0.0;
        for (int64_t k = 0; k < n; k++) {
            acceleration += fabs(row[k]) * limit->accelerations[k];
            velocity += fabs(row[k]) * limit->velocities[k];
        }
        acceleration *= limit->share;
        time = approach > velocity ? 0.0 : approach / (acceleration > 1e-9 ? acceleration : 1e-9);
        time = time < limit->longest ? time : limit->longest;
    }
    time = time > braking ? time : braking;
    double rate = 1.0 / (delay + 0.5 * time);
    rate = rate < limit->rate ? rate : limit->rate;
    return approach - (room < 0.0 ? limit->retreat : rate) * room;
}

/* A number that is not smaller than the result of bound. */
static double bound_of_bounds(const Limit *limit, double room, double approach, double delay, double braking)
{
    double time = approach > 0.0 && limit->longest > braking ? limit->longest : braking;
    double rate = 1.0 / (delay + 0.5 * time);
    rate = rate < limit->rate ? rate : limit->rate;
    return approach - (room < 0.0 ? limit->retreat : rate) * room;
}

/* Whether some velocity v within bounds violates row . v >= least. */
static int violable(const double *row, int64_t n, double least, const double *lower, const double *upper)
{
    double smallest = 0.0;
    for (int64_t k = 0; k < n; k++)
        smallest += row[k] * (row[k] > 0.0 ? lower[k] : upper[k]);
    return least > smallest;
}

/* Whether no joint changes the distance of a row. */
static int unmoved(const double *row, int64_t n, double least)
{
    double squared = 0.0;
    for (int64_t k = 0; k < n; k++)
        squared += row[k] * row[k];
    return squared <= least * least;
}

/* Find the rows of all pairs of an obstacle and a sphere that are within the reach of the sphere.
 *
 * dt: time from the poses of the obstacles to now, which is at time `time`. centers (m, 3); reach (m). margins: of each
 * obstacle, may be null. velocity (n) of the joints, may be null. lower, upper (n): bounds of the next velocity; rows
 * that no velocity within them violates are left out. scratch: 3 n + 1 numbers for each sphere. Out: for each of at most
 * n_obstacles * m rows, the indices of obstacle and sphere (2 each), the remaining distance and the least allowed
 * derivative (2 each), and the row (n each). Returns their number. */
int64_t obstacle_rows(const Obstacles *obstacles, double dt, double time, const Arm *arm, const double *centers,
                      const double *reach, const Limit *limit, const double *margins, const double *velocity,
                      const double *lower, const double *upper, double *scratch, int64_t *indices, double *values,
                      double *rows)
{
    int64_t found = 0, n = arm->n;
    double *jacobians = scratch, *speeds = scratch + 3 * n * arm->m; /* a negative speed is not known yet */
    double braking = braking_time(limit, velocity, n);
    int still = 1;
    Solid solid;
    for (int64_t i = 0; i < 3 * obstacles->n; i++)
        still = still && obstacles->velocities[i] == 0.0 && obstacles->rates[i] == 0.0;
    for (int64_t j = 0; j < arm->m; j++)
        speeds[j] = -1.0;
    for (int64_t i = 0; i < obstacles->n; i++) {
        const double *v = obstacles->velocities + 3 * i, *w = obstacles->rates + 3 * i;
        const double *P = obstacles->covariances + 9 * i;
        double delay = limit->delay + (still ? 0.0 : fmax(time - obstacles->stamps[i], 0.0));
        place(&solid, obstacles, i, dt);
        for (int64_t j = 0; j < arm->m; j++) {
            const double *c = centers + 3 * j;
            double d[3] = {c[0] - solid.center[0], c[1] - solid.center[1], c[2] - solid.center[2]}, normal[3];
            double far = reach[j] + solid.radius, *jacobian = jacobians + 3 * n * j, *row = rows + n * found;
            if (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > far * far)
                continue;
            double room = signed_distance(&solid, c, normal);
            if (!(room <= reach[j]))
                continue;
            double approach = normal[0] * (v[0] + w[1] * d[2] - w[2] * d[1]) +
                              normal[1] * (v[1] + w[2] * d[0] - w[0] * d[2]) +
                              normal[2] * (v[2] + w[0] * d[1] - w[1] * d[0]);
            room -= limit->reduced[j] + (margins ? margins[i] : 0.0);
            if (limit->deviations > 0.0) {
                double variance = 0.0;
                for (int r = 0; r < 3; r++)
                    variance += normal[r] * (P[3 * r] * normal[0] + P[3 * r + 1] * normal[1] + P[3 * r + 2] * normal[2]);
                room -= limit->deviations * sqrt(variance > 0.0 ? variance : 0.0);
            }
            if (speeds[j] < 0.0) {
                point_jacobian(jacobian, arm, c, arm->moves + n * j);
                speeds[j] = fastest(jacobian, lower, upper, n);
            }
            if (bound_of_bounds(limit, room, approach, delay, braking) < -speeds[j] - ROUNDING)
                continue;
            along(row, jacobian, normal, n);
            double least = bound(limit, row, n, room, approach, delay, braking);
            if (!violable(row, n, least, lower, upper) || (least > 0.0 && unmoved(row, n, limit->unmoved)))
                continue;
            indices[2 * found] = i;
            indices[2 * found + 1] = j;
            values[2 * found] = room;
            values[2 * found + 1] = least;
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

/* Pairs of spheres of two links: group k begins with pair starts[k]; radii are those of all spheres. The numbers of the
 * base's spheres, whose centres are base_centers, follow those of the arm. Numbers of spheres are short, so that all
 * pairs stay in the processor's nearest cache. */
typedef struct {
    int64_t n_pairs, n_groups;
    const uint16_t *outer, *inner;
    const double *radii;
    const int64_t *starts;
    const double *base_centers;
} SpherePairs;

static const double *center_of(const SpherePairs *pairs, const Arm *arm, const double *centers, int64_t sphere)
{
    return sphere < arm->m ? centers + 3 * sphere : pairs->base_centers + 3 * (sphere - arm->m);
}

/* Find every pair nearer than close, at most the nearest `most`, and the nearest pair of each of the n_groups nearest
 * groups that are nearer than near.
 *
 * centers (m, 3) of the arm's spheres. scratch: room for n_pairs + n_groups pairs. Out: the pairs' indices in SpherePairs, ordered by distance, their distances, and their
 * rows (n each). Returns their number, at most most + n_groups.
 *
 * The distance less the clearance may shrink by gain (1/s) times itself; if it is negative, it must grow by retreat
 * times its magnitude. If no velocity between lower and upper (n) violates this for any pair, the result is 0. If lower
 * is null, this is not tested. */
int64_t self_rows(const SpherePairs *pairs, const Arm *arm, const double *centers,
                  int64_t n_groups, double near, double close, int64_t most, double clearance, double gain,
                  double retreat, const double *lower, const double *upper, Pair *scratch, int64_t *indices,
                  double *distances, double *rows)
{
    Pair *best = scratch, *chosen = scratch + pairs->n_groups;
    int64_t n_close = 0, found = 0, n = arm->n;
    int effect = !lower;
    double jacobian[3 * MAX_JOINTS], moves[MAX_JOINTS];
    for (int64_t g = 0; g < pairs->n_groups; g++) {
        int64_t end = g + 1 < pairs->n_groups ? pairs->starts[g + 1] : pairs->n_pairs;
        double nearest = near;
        best[g].distance = INFINITY;
        best[g].index = pairs->starts[g];
        for (int64_t k = pairs->starts[g]; k < end; k++) {
            int64_t inner = pairs->inner[k];
            const double *a = centers + 3 * pairs->outer[k];
            const double *b = center_of(pairs, arm, centers, inner);
            double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2], sum = pairs->radii[pairs->outer[k]] + pairs->radii[inner];
            double squared = x * x + y * y + z * z, within = sum + (nearest > close ? nearest : close);
            if (within < 0.0 || squared > within * within * (1.0 + 1e-12))
                continue;
            double distance = sqrt(squared) - sum;
            if (distance < nearest) {
                nearest = best[g].distance = distance;
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
    for (int64_t g = 0; g < n_groups && g < pairs->n_groups && best[g].distance < near; g++) {
        int known = 0;
        for (int64_t k = 0; k < kept && !known; k++)
            known = chosen[k].index == best[g].index;
        if (!known)
            best[found++] = best[g];
    }
    for (int64_t k = 0, a = 0, b = 0; k < kept + found; k++) { /* merge both, which are in order */
        Pair pair = b >= found || (a < kept && nearer(chosen + a, best + b) < 0) ? chosen[a++] : best[b++];
        int64_t outer = pairs->outer[pair.index], inner = pairs->inner[pair.index];
        const double *one = centers + 3 * outer;
        const double *other = center_of(pairs, arm, centers, inner);
        double length = pair.distance + pairs->radii[outer] + pairs->radii[inner], normal[3];
        for (int64_t c = 0; c < 3; c++)
            normal[c] = (one[c] - other[c]) / length;
        for (int64_t c = 0; c < n; c++) /* joints that move both spheres do not change their distance */
            moves[c] = arm->moves[n * outer + c] - (inner < arm->m ? arm->moves[n * inner + c] : 0.0);
        point_jacobian(jacobian, arm, one, moves);
        along(rows + n * k, jacobian, normal, n);
        indices[k] = pair.index;
        distances[k] = pair.distance;
        double room = pair.distance - clearance;
        effect = effect || violable(rows + n * k, n, (room < 0.0 ? -retreat : -gain) * room, lower, upper);
    }
    return effect ? kept + found : 0;
}
