/* Obstacles as imitarm.scene.distances.PackedObstacles keeps them, and the signed distance of a point to one of them. */

#ifndef IMITARM_SHAPES_H
#define IMITARM_SHAPES_H

#include <stdint.h>

/* Polytope: m faces and e edges; arrays as in imitarm.scene.convex_hull.Polytope */
typedef struct {
    int64_t m, e;
    const double *normals, *offsets, *cosines, *starts, *directions, *lengths;
} Hull;

/* n obstacles; arrays as in PackedObstacles, and for each obstacle its hull or a null pointer */
typedef struct {
    int64_t n;
    const int8_t *kinds;
    const double *positions, *quaternions, *sizes, *velocities, *rates, *covariances, *radii, *stamps;
    const Hull *const *hulls;
} Obstacles;

/* One obstacle at one time: to_local rotates base vectors into its local frame, which is at center. */
typedef struct {
    int kind;
    double to_local[9], center[3], size[3], radius;
    const Hull *hull;
} Solid;

/* Radius of the sphere around the origin of a shape that contains it; not for hulls. */
double bounding_radius(int kind, const double *size);

/* Place obstacle i of a scene, dt seconds after the time of the arrays. */
void place(Solid *solid, const Obstacles *obstacles, int64_t i, double dt);

/* Signed distance of a point in the base frame; its gradient in the base frame, unless normal is null. */
double signed_distance(const Solid *solid, const double *point, double *normal);

#endif
