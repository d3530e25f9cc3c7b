// Single rays through Embree from several threads, for tools/ray_speed.py: a shared library of C
// functions that works with Embree 3 and 4.
#include <pthread.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

#ifdef EMBREE_4
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

enum { CHUNK = 4096 };

typedef struct {
    RTCScene scene;
    const float *origins;    // x y z of each ray
    const float *directions; // x y z of each ray
    float t_max;
    unsigned *triangles;     // hit by each ray; NULL: only whether there is one
    float *t;                // of the hit; -inf where a ray is blocked
    size_t count;
    atomic_size_t next;
} Job;

static void set_ray(struct RTCRay *ray, const Job *job, size_t i)
{
    memset(ray, 0, sizeof *ray);
    ray->org_x = job->origins[3 * i];
    ray->org_y = job->origins[3 * i + 1];
    ray->org_z = job->origins[3 * i + 2];
    ray->dir_x = job->directions[3 * i];
    ray->dir_y = job->directions[3 * i + 1];
    ray->dir_z = job->directions[3 * i + 2];
    ray->tfar = job->t_max;
    ray->mask = -1;
}

static void trace_one(const Job *job, size_t i)
{
#ifndef EMBREE_4
    struct RTCIntersectContext context;
    rtcInitIntersectContext(&context);
#endif
    if (job->triangles) {
        struct RTCRayHit hit;
        set_ray(&hit.ray, job, i);
        hit.hit.geomID = hit.hit.instID[0] = hit.hit.primID = RTC_INVALID_GEOMETRY_ID;
#ifdef EMBREE_4
        rtcIntersect1(job->scene, &hit, NULL);
#else
        rtcIntersect1(job->scene, &context, &hit);
#endif
        job->triangles[i] = hit.hit.primID;
        job->t[i] = hit.ray.tfar;
    } else {
        struct RTCRay ray;
        set_ray(&ray, job, i);
#ifdef EMBREE_4
        rtcOccluded1(job->scene, &ray, NULL);
#else
        rtcOccluded1(job->scene, &context, &ray);
#endif
        job->t[i] = ray.tfar;
    }
}

static void *work(void *argument)
{
    Job *job = argument;
    for (;;) {
        const size_t first = atomic_fetch_add(&job->next, CHUNK);
        if (first >= job->count)
            return NULL;
        const size_t end = first + CHUNK < job->count ? first + CHUNK : job->count;
        for (size_t i = first; i < end; ++i)
            trace_one(job, i);
    }
}

/// A tree over `count` triangles of nine floats each; never released.
void *embree_scene(const float *corners, size_t count)
{
    RTCDevice device = rtcNewDevice(NULL);
    RTCGeometry geometry = rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE);
    float *vertices = rtcSetNewGeometryBuffer(
        geometry, RTC_BUFFER_TYPE_VERTEX, 0, RTC_FORMAT_FLOAT3, 3 * sizeof(float), 3 * count);
    unsigned *indices = rtcSetNewGeometryBuffer(
        geometry, RTC_BUFFER_TYPE_INDEX, 0, RTC_FORMAT_UINT3, 3 * sizeof(unsigned), count);
    memcpy(vertices, corners, 9 * count * sizeof(float));
    for (size_t i = 0; i < 3 * count; ++i)
        indices[i] = (unsigned)i;
    rtcCommitGeometry(geometry);
    RTCScene scene = rtcNewScene(device);
    rtcAttachGeometry(scene, geometry);
    rtcCommitScene(scene);
    return scene;
}

/// Trace `count` rays with `threads` threads, at most 256.
void embree_trace(
    void *scene,
    const float *origins,
    const float *directions,
    float t_max,
    size_t count,
    unsigned *triangles,
    float *t,
    unsigned threads)
{
    Job job = {scene, origins, directions, t_max, triangles, t, count, 0};
    pthread_t others[256];
    unsigned started = 0;
    while (started + 1 < threads && started < 256
           && pthread_create(&others[started], NULL, work, &job) == 0)
        ++started;
    work(&job);
    for (unsigned k = 0; k < started; ++k)
        pthread_join(others[k], NULL);
}
