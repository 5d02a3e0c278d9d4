/*
 * A stand-in for the header of Quanser's Stream API, for machines without QUARC. It declares the functions that
 * stream_side.c uses, with the signatures and the meaning that Quanser documents at
 * https://docs.quanser.com/quarc/documentation (pages stream_listen_c.html, stream_accept_c.html,
 * stream_set_byte_order_c.html, stream_receive_double_array_c.html, stream_send_double_array_c.html,
 * stream_flush_c.html, stream_close_c.html, tcpip_protocol.html). With QUARC, leave this directory out.
 */
#ifndef STANDIN_QUANSER_STREAM_H
#define STANDIN_QUANSER_STREAM_H

typedef char t_boolean;
typedef int t_int;
typedef unsigned int t_uint;
typedef int t_error;
typedef double t_double;
typedef struct tag_stream *t_stream;

typedef enum tag_stream_byte_order {
    STREAM_BYTE_ORDER_NATIVE_ENDIAN,
    STREAM_BYTE_ORDER_LITTLE_ENDIAN,
    STREAM_BYTE_ORDER_BIG_ENDIAN
} t_stream_byte_order;

/* Error codes are returned negated. Quanser's value of the first is 34; the others are the stand-in's own. */
#define QERR_WOULD_BLOCK 34
#define QERR_STANDIN_ARGUMENT 1001
#define QERR_STANDIN_MEMORY 1002
#define QERR_STANDIN_SOCKET 1003

/* Listens on "tcpip://host:port?option=value,...". Ignores the host, as QUARC does. Returns 0 or an error. */
t_error stream_listen(const char *uri, t_boolean non_blocking, t_stream *server_stream);

/*
 * Accepts a connection, which is non-blocking if its server is. Returns 0, -QERR_WOULD_BLOCK if no client waits, or
 * another error. Buffer sizes are in bytes.
 */
t_error stream_accept(t_stream server_stream, t_int send_buffer_size, t_int receive_buffer_size,
                      t_stream *client_stream);

/* Sets the byte order of numbers on the wire. Returns 0 or an error. */
t_error stream_set_byte_order(t_stream stream, t_stream_byte_order byte_order);

/*
 * Receives the whole array or nothing. The receive buffer must hold the array. Returns 1, 0 if the peer has closed the
 * connection and fewer bytes are left, -QERR_WOULD_BLOCK if fewer bytes have arrived, or another error.
 */
t_int stream_receive_double_array(t_stream stream, t_double *elements, t_uint num_elements);

/*
 * Stores the whole array in the send buffer or nothing. The send buffer must hold the array. Returns 1,
 * -QERR_WOULD_BLOCK if there is no room, even after sending what the connection takes, or another error.
 */
t_int stream_send_double_array(t_stream stream, const t_double *elements, t_uint num_elements);

/*
 * Sends the contents of the send buffer. Returns 0 if nothing is left, -QERR_WOULD_BLOCK if something is left, even if
 * a part was sent, or another error.
 */
t_error stream_flush(t_stream stream);

/* Closes a stream. Returns 0. */
t_error stream_close(t_stream stream);

#endif
